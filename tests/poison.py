"""A task whose cells misbehave on the analytic system, by their stiffness; where, a file keeps account."""

import os
import signal
import time
from pathlib import Path

from mjx_study.reference import ReferenceObjective
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

CRASH, RAISE, SLOW = 13.0, 17.0, 19.0  # [N/m]
ACCOUNT = "MJX_STUDY_TEST_ACCOUNT"


def poison(horizon: int = 5) -> Task:
    """The pusher, short."""
    task = make_task("pusher", horizon=horizon)
    whole = task.reference
    assert whole is not None

    def reference(stiffness: float) -> ReferenceObjective:
        if stiffness in (CRASH, RAISE):
            with Path(os.environ[ACCOUNT]).open("a") as file:
                print(stiffness, file=file)
        if stiffness == CRASH:
            os.kill(os.getpid(), signal.SIGKILL)
        if stiffness == RAISE:
            raise MemoryError("no memory for the batch\nand more")
        if stiffness >= SLOW:
            time.sleep(0.3)
        return whole(stiffness)

    return task.replace(reference=reference)
