"""mjx-study bench."""

import argparse

from mjx_study import bench as benchmark
from mjx_study.cli.options import computing, configure_process, print_report, usage_errors
from mjx_study.cli.parameters import task_of


def run(options: argparse.Namespace) -> int:
    with usage_errors():
        configure_process(options)
        plan = benchmark.plan_bench(task_of(options), options.samples)
    with computing() as progress:
        report = benchmark.bench(plan, progress)
    print_report(options, report.as_json(), report.lines())
    return 0
