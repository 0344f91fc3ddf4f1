"""mjx-study diagnose."""

import argparse

from mjx_study.choices import FAMILIES, is_file
from mjx_study.cli.options import computing, configure_process, print_report, usage_errors
from mjx_study.cli.parameters import task_of
from mjx_study.diagnose import diagnose


def run(options: argparse.Namespace) -> int:
    """Measure and print; return 1 if a derivative is wrong."""
    with usage_errors():
        configure_process(options)
        task = task_of(options)
        if not is_file(options.task):  # other commands default to several
            options.contact = options.contact or task.defaults.main_family
            if FAMILIES[options.contact].swept:
                options.stiffness = options.stiffness or task.defaults.middle_stiffness
    names = ("contact", "stiffness", "damping", "sigma", "horizon", "cone", "model")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    given |= {"seed": options.seed} if options.seed else {}
    flags = "".join(f" --{name} {value:{'g' if isinstance(value, float) else ''}}" for name, value in given.items())
    with computing() as progress, usage_errors():
        found = diagnose(
            options.task,
            task,
            options.contact,
            options.stiffness,
            damping=options.damping,
            samples=options.samples,
            seed=options.seed,
            options=flags,
            progress=progress,
        )
    print_report(options, found.as_json(), found.lines())
    return 0 if found.derivatives.passed else 1
