"""Theorem 1 along a run: its conditions, the steps of its proof, and the text of `ambjax check`.

from ambjax.theorem import check

report = check(case, settle=case.settle)
[line.name for line in report.conditions if line.holds is False]
"""

from ambjax.theorem.conditions import Condition, Report, check, delta_1_on_reference
from ambjax.theorem.sampled_report import SampledReport, check_sampled

__all__ = ["Condition", "Report", "SampledReport", "check", "check_sampled", "delta_1_on_reference"]
