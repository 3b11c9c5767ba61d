"""The paper's simulation study: readings of it, evidence from them, and the ledger of its claims."""

from ambjax.paper.readings import (
    CLOCK,
    NOISY,
    PULSE,
    READINGS,
    REFERENCE,
    REPAIRED_GAMMA,
    SETTLE,
    SUPPLY,
    TABLE_2,
    TUNED,
    cascade,
    noisy,
    on_processor,
    scenario,
)

__all__ = [
    "CLOCK",
    "NOISY",
    "PULSE",
    "READINGS",
    "REFERENCE",
    "REPAIRED_GAMMA",
    "SETTLE",
    "SUPPLY",
    "TABLE_2",
    "TUNED",
    "cascade",
    "noisy",
    "on_processor",
    "scenario",
]
