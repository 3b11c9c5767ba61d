"""The text below the tables of `ambjax check`: the verdict, the gains to change, the rotor's status, the advice."""

import math
import re

from ambjax.text.words import command
from ambjax.theorem.causes import Cause, cause_words
from ambjax.theorem.conditions import Condition, Report
from ambjax.theorem.law_poles import LEAST_DAMPING
from ambjax.theorem.sampled_report import Delays, SampledReport

QUESTION = "Do the conditions of Theorem 1 hold along this run?"
# Ratio of an advised gain to the number that it must exceed; the result is rounded up to two digits.
MARGIN = 1.1
# Share of the time until the rotor is lost, after which it counts as falling.
FALL_SHARE = 0.9
# Ratio of gamma to the Delta_1 of the ideal motion z = r; it leaves room for transients.
TRANSIENT_FACTOR = 2.0
# Clauses on a lost rotor for `cause_words`.
LOSS = ("the rotor is lost", "the rotor is held")
# Advice for a run in which the integrator stalled.
STALLED = (
    "Lower the steepness p of the laws ([controller.inversion] p first), "
    'or use a fixed step: [clock] dt = 1e-6 with method = "rodas3".'
)
# The same on a processor, where only the plant is integrated.
STALLED_PLANT = 'Use fixed steps of the plant, which cannot stall: [clock] dt = 1e-6 with method = "rodas3".'


def theorem_lines(report: Report, case: str) -> list[str]:
    """Return the lines below the table of `ambjax check`. `case`: file name as given by the user."""
    deciding = [line for line in report.conditions if line.holds is not None]
    fails = [line for line in deciding if not line.holds]
    if not deciding:
        words = "No condition applies to these laws."
    elif not fails:
        words = f"Yes, all {len(deciding)} that apply to these laws do."
    else:
        words = f"No, {len(fails)} of {len(deciding)} {'does' if len(fails) == 1 else 'do'} not:"
    lines = [f"{QUESTION} {words}"]
    lines += [f"- {line}" for line in advice(report)]
    lines.append(_status(report, bool(fails)))
    if fails or report.lost:
        tune = command("ambjax", "tune", case)
        lines.append(f"{tune} searches for gains that hold the rotor and meet these conditions with a margin.")
    return lines


def advice(report: Report) -> list[str]:
    """Return a line for each gain whose condition fails, with its bound and a value to set; then the other failures.

    While a rotor falls, its motion increases Delta_1 beyond any gain. Therefore a worst value in the last tenth of a
    lost run is not used to advise a gain, and is reported only if no other condition on a gain fails.
    """
    fails = [line for line in report.conditions if line.holds is False]
    fall = FALL_SHARE * report.lost_at if report.lost else math.inf
    rows = [line for line in fails if line.path and (line.ideal or line.at_s < fall)]
    paths = dict.fromkeys(row.path for row in rows)
    largest = (max((row for row in rows if row.path == path), key=lambda row: row.against) for path in paths)
    lines = [_to_raise(row) for row in largest]
    if not rows:
        ideal = {line.path: line for line in report.conditions if line.ideal}
        lines = [_during_fall(line, ideal.get(line.path)) for line in fails if line.path]
    lines += [
        f"{line.requires} fails: {line.note}."
        if line.note
        else f"{line.requires} fails at {line.at_s:.4g} s: choose a smaller reference or initial.z, or an initial "
        "i_ref ([controller.inversion] i_ref) on the other side of the singular curve C."
        for line in fails
        if not line.path
    ]
    return lines


def processor_lines(sampled: SampledReport, margin: Delays, unknown: Delays | None) -> list[str]:
    """Return the lines below the tables of a cascade on a processor.

    They report the poles of the laws, the distance to C, the status of the rotor, an alternating voltage, and the delay
    margins. `margin`: delay margin; a prediction, if there is one, uses the actual delay. `unknown`: delay margin if
    the prediction uses the delay of the case; None: the controller does not predict.
    """
    lines = [
        f"- {law.stage}: the largest |pole| is {number(law.radius)} and must be less than 1, the least damping ratio "
        f"is {number(law.damping)} and must be at least {LEAST_DAMPING:g}. Remedy: {', or '.join(law.remedies)}."
        for law in sampled.laws
        if not law.holds
    ]
    words = f"No, {len(lines)} of {len(sampled.laws)} {'is' if len(lines) == 1 else 'are'} not:" if lines else "Yes."
    end = status(sampled.lost_at, sampled.lost_why, sampled.stalled, STALLED_PLANT)
    lines = [f"Is the discrete step of every law stable? {words}", *lines]
    lines += [_curve(*sampled.distance)] * math.isfinite(sampled.distance[0]) + [end]
    if sampled.cause is not None:
        lines.append(cause_words(sampled.cause, *LOSS))
    if sampled.alternates:
        lines.append(_alternates(sampled.alternating or 0.0, sampled.alternation_cause))
    if unknown is None:
        return [*lines, _margin("Delay margin", margin)]
    return [
        *lines,
        _margin("Delay margin if the prediction uses the actual delay", margin),
        _margin("Delay margin if the prediction uses the case's delay", unknown),
    ]


def delay_difference(linear: float | None, tested: Delays, delay: float, period: float) -> str:
    """Return why the simulated loop is stable at delays beyond the linear delay margin; '' if it is not.

    `linear`: delay margin of the linearised loop at the command, s; None: not known. `tested`: the simulated delays,
    for which the prediction uses the delay of the case. `delay`: of the case, samples. `period`: sample period, s.
    """
    later = 0.0 if tested.stable is None else (tested.stable - delay) * period
    if linear is None or linear >= later:
        return ""
    return (
        f"The linear delay margin at the command, {linear:.3g} s, is smaller than the {later:.3g} s tested. Beyond it "
        "small motions do not decay: the voltage alternates, as within the band of a set-valued sign, but the "
        "amplitude of z stays below 1 % of the clearance, so that this does not count as unstable."
    )


def _curve(distance: float, at: float) -> str:
    question = "Does (z/s_0, i_ref/i_0) stay off the singular curve C at all samples?"
    if distance > 0:
        return f"{question} Yes: the smallest distance is {number(distance)}, at {at:.4g} s."
    return (
        f"{question} No: it is {number(-distance)} beyond C at {at:.4g} s. Choose a smaller reference, a slower "
        "position law (c, k), or an observer that attenuates the noise more."
    )


def _alternates(share: float, cause: Cause | None) -> str:
    words = (
        f"The voltage alternates: without noise, the part that changes sign from sample to sample is {100 * share:.0f} "
        "% of its rms value."
    )
    return (
        words if cause is None else f"{words} {cause_words(cause, 'it alternates', 'the voltage does not alternate')}"
    )


def _margin(name: str, margin: Delays) -> str:
    held, lost, undecided = margin.held, margin.lost, margin.undecided
    if held is None and undecided is None:
        return f"{name}: none, because the rotor is lost even without a delay."
    parts = [] if held is None else [f"held up to {_samples(held)} samples"]
    if undecided is not None:
        parts += [f"not decided at {_samples(undecided)}, where the integrator stalled"]
        parts += [] if lost is None else [f"lost at {_samples(lost)}"]
    elif lost is None:
        parts += ["the longest delay that ambjax simulates"]
    else:
        parts = [f"{parts[0]} and lost at {_samples(lost)}"]
    tried = f"tested in steps of {margin.step:.2g} samples"
    return f"{name}: the rotor is {', '.join(parts)} ({tried}).{_stable(margin)}"


def _stable(margin: Delays) -> str:
    """Return the sentence on the delays at which the rotor is held, but the loop is not stable."""
    if not margin.tested or margin.held is None:
        return ""
    if margin.swing_m is None or margin.current_A is None:
        return f" The loop is stable at all {margin.tested} delays tested up to there."
    upto = "not stable:" if margin.stable is None else f"stable up to {_samples(margin.stable)} samples only: beyond,"
    return (
        f" The loop is {upto} the rotor is held, but its motion does not decay without noise and loads "
        f"(amplitude up to {margin.swing_m:.3g} m, |i| up to {margin.current_A:.3g} A)."
    )


def _samples(delay: float) -> str:
    """Format a number of samples with up to five decimals: 1.48676, 0.5, 2."""
    return f"{delay:.5f}".rstrip("0").rstrip(".")


def _to_raise(line: Condition) -> str:
    if not math.isfinite(line.against):
        return f"{line.requires} cannot be evaluated: its right-hand side is not finite along this run."
    name, key, gain = _sides(line)
    return (
        f"{name} = {gain} must exceed {number(line.against)} {line.unit} ({line.over}, at "
        f"{line.at_s:.4g} s): set {key} above {number(_up(MARGIN * line.against))}."
    )


def _during_fall(line: Condition, ideal: Condition | None) -> str:
    """Return the advice on a gain whose condition fails only while the rotor falls."""
    name, key, gain = _sides(line)
    words = (
        f"{line.over} = {number(line.against)} {line.unit} exceeds {name} = {gain} at "
        f"{line.at_s:.4g} s, while the rotor falls. Do not choose {name} by this value: another gain, a disturbance, "
        "noise or the supply may cause the fall."
    )
    if ideal is not None and ideal.gain is not None and ideal.gain < TRANSIENT_FACTOR * ideal.against:
        words += (
            f" {name} may cause it too: the reference alone requires {number(ideal.against)}, and transients require "
            f"more. In that case set {key} above {number(_up(TRANSIENT_FACTOR * ideal.against))}."
        )
    return words


def _sides(line: Condition) -> tuple[str, str, str]:
    """Return the name of the gain of a condition, its key in a case file, and its value, as text."""
    _, stage, name = line.path.split(".")
    return name, f"[controller.{stage}] {name}", number(line.gain or 0.0)


def _status(report: Report, fails: bool) -> str:
    words = [status(report.lost_at, report.lost_why, report.stalled)]
    if report.lost and not fails:
        words.append(
            "The theorem assumes an exact model, no noise, no voltage limit and no sampling, and it does not bound the "
            "motion before sigma is 0."
        )
    if report.cause is not None:
        words.append(cause_words(report.cause, *LOSS))
    if math.isinf(report.lost_at) and fails:
        return "The rotor is held nevertheless: the conditions are sufficient, not necessary."
    return " ".join(words)


def status(lost_at: float, lost_why: str, stalled: bool, remedy: str = STALLED) -> str:
    """Return the sentence on the rotor's status that every command prints: held, lost, or not decided.

    `lost_at`: time (s) at which the run ended early, +inf if it did not. `stalled`: whether it ended because the
    integrator stalled; `remedy` is then added.
    """
    if math.isinf(lost_at):
        return "The rotor is held."
    if not stalled:
        return f"The rotor is lost at {lost_at:.4g} s: {lost_why}."
    return (
        f"The status of the rotor is not decided: at {lost_at:.4g} s the integrator stalled, because it could not meet "
        f"its tolerance. {remedy}"
    )


def number(x: float) -> str:
    """Format a number: plain if that is short, else with three digits and a short exponent (1000, 6.23e4)."""
    if 1e-3 <= abs(x) < 1e4:
        return f"{x:.4g}"
    return re.sub(r"e([+-])0*", lambda e: "e-" if e[1] == "-" else "e", f"{x:.3g}")


def _up(x: float) -> float:
    """Round x up to two digits."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return math.ceil(x / unit - 1e-9) * unit
