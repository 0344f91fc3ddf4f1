"""`python -m mjx_study` is `mjx-study`."""

import sys

from mjx_study.cli import main

sys.exit(main())
