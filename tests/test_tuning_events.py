"""The log of a tuning: lines on stderr, never silent for long."""

import math
import sys
import time

import numpy as np
import pytest

from ambjax.host import heartbeat
from tuning import events
from tuning.events import Event, Log, Reached, Standing
from tuning.problem.limits import Limit
from tuning.problem.quantities import KINDS

STANDING = Standing(1, 3, 40, 2, 1e-6, 5.0, 39, 40, (Reached("sensitivity", 6.0, 3.0, False, 6.0),), math.nan)


def test_a_norm_over_members_is_no_broken_limit_while_the_worst_member_may_be_within():
    """Ten equal members at 2.5 A have the 16-norm 2.89 A."""
    limit = Limit("rms_coil_A", 2.7)
    norm = float(KINDS["rms_coil_A"].tuned(np.full(10, 2.5)))
    low = limit.other_bound(norm, 10)
    assert low == pytest.approx(2.5)
    assert "from 2.5 to 2.89 (limit 2.7)" in Reached("rms_coil_A", norm, 2.7, limit.holds(norm), low).text
    assert "2.89 (beyond 2.4)" in Reached("rms_coil_A", norm, 2.4, False, low).text
    assert "2.89 (within 3)" in Reached("rms_coil_A", norm, 3.0, True, low).text
    known = limit.updated(norm, 2.5)  # a judged value
    assert known.other_bound(2.5, 10) == 2.5


@pytest.mark.parametrize("terminal", [False, True])
def test_the_last_line_is_repeated_if_nothing_happens(terminal, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.setattr(heartbeat, "SILENCE", 0.1)
    with Log() as log:
        log(Event("compiling"))
        time.sleep(0.4)
    said = capsys.readouterr().err
    assert said.count("compiling") > 1
    assert ("\r" in said) == terminal
    time.sleep(0.3)
    assert capsys.readouterr().err == ""  # it has ended


def test_a_command_says_what_takes_long_and_only_that(monkeypatch, capsys):
    monkeypatch.setattr(heartbeat, "SILENCE", 0.1)
    with heartbeat.Heartbeat():
        with heartbeat.doing("short"):
            pass
        with heartbeat.doing("compiling"):
            time.sleep(0.4)
        with heartbeat.doing("outer"), Log() as log:  # only the inner one writes
            log(Event("inner"))
            time.sleep(0.3)
        said = capsys.readouterr().err
        time.sleep(0.3)
    assert said.count("compiling") > 1
    assert said.count("inner") > 1
    assert "short" not in said
    assert "outer" not in said
    with heartbeat.doing("called from Python"):
        time.sleep(0.3)
    assert capsys.readouterr().err == ""


def test_standings_are_written_at_intervals_and_other_events_at_once(monkeypatch, capsys):
    log = Log()
    for interval, event in ((0.0, Event(STANDING.text, STANDING)), (1e9, Event(STANDING.text, STANDING))):
        monkeypatch.setattr(events, "SILENCE", 2 * interval)
        log(event)
    for _ in range(3):
        log(Event("join"))
    said = capsys.readouterr().err
    assert said.count("search 1: iteration 3") == 1
    assert said.count("join") == 3
