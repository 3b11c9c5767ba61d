"""The name that a user probably means: another word for the same quantity, or a similar spelling."""

import difflib
from collections.abc import Iterable

# Other words for the names of the case file, in lower case, without '_' and '-'. A key with a dot is the full path of a
# name. `meant` returns this path if no allowed name has the other word.
OTHER_WORDS = {
    "plant": "rotor machine magnet magnets bearing system motor",
    "controller": "control gains regulator",
    "processor": "dsp cpu microcontroller sampling discrete",
    "reference": "setpoint target command desired",
    "disturbance": "load loads disturbances perturbation excitation",
    "sensor": "noise measurement probe",
    "actuator": "amplifier supply drive inverter",
    "initial": "start state x0 ic initialconditions",
    "clock": "time simulation solver integration",
    "run": "settings options",
    "spread": "uncertainty montecarlo ensemble tolerances",
    "tune": "tuning optimise optimize optimisation",
    "m": "mass weight rotormass",
    "k_z": "stiffness k kz springrate passivestiffness",
    "mu_0": "permeability mu",
    "n": "turns windings",
    "A": "area polearea",
    "s_0": "gap airgap nominalgap delta",
    "i_0": "bias biascurrent ibias",
    "R": "resistance coilresistance",
    "g": "gravity",
    "state-feedback": "lqr lq fullstate poleplacement",
    "observer": "estimator filter kalman",
    "inversion": "linearisation linearization force",
    "position": "outer",
    "current": "inner",
    "sample_period": "samplerate samplingrate samplingperiod sampletime samplingfrequency frequency rate fs ts period",
    "duration": "tend endtime stoptime length simulationtime",
    "dt": "step stepsize timestep h",
    "method": "integrator scheme",
    "frequency": "freq f hz omega",
    "amplitude": "amp height size magnitude",
    "value": "constant level offset",
    "start": "t0 begin from delay ton",
    "stop": "end until t1 toff",
    "speed": "rpm rotationalspeed",
    "unit": "units",
    "file": "path filename csv",
    "std": "sigma rms standarddeviation noise variance",
    "bits": "resolution adc",
    "saturation": "bsat bs bmax saturationflux",
    "leakage": "leakagefactor stray",
    "eddy": "eddycurrents lamination tau",
    "bandwidth": "cutoff cutofffrequency lowpass",
    "u_max": "supply voltage umax vmax dclink limit voltagelimit supplyvoltage",
    "i_max": "currentlimit maxcurrent",
    "coil": "coils channel halfbridge percoil",
    "unidirectional": "oneway unipolar singlequadrant diode",
    "seed": "randomseed rng",
    "settle": "settling settlingtime",
    "clearance": "touchdown safetygap",
    "stop_stiffness": "stop contactstiffness touchdownstiffness",
    "stop_damping": "contactdamping touchdowndamping",
    "z": "position x displacement",
    "z_dot": "velocity v speed zdot",
    "i": "current",
    "q_z": "q force f load accel acceleration",
    "q_i": "qi voltage",
    "base": "housing foundation basemotion ground",
    "kind": "type name",
    "rms_error_m": "rmserror settledrmserror settledrmserrorm",
    "rms_u_V": "rmsu voltage rmsvoltage settledrmsuv",
    "max_u_V": "umax maxu maxvoltage peakvoltage maxabsuv",
    "max_abs_i_A": "imax maxi maxia maxcurrent maxcurrenta peakcurrent",
    "rms_coil_A": "rmsi rmsia rmscurrent rmscurrenta coilcurrent rmsi1a rmsi2a",
    "chatter_V_per_s": "chatter chatterv",
    "largest_error_m": "maxerror maxerrorm peakerror deflection maxabserrorm settledmaxabserrorm",
    "settling_s": "settle settlingtime settlingtimes",
    "clearance_used": "clearance",
    "z_1x_m": "z1x displacement1x displacement1xm vibration",
    "i_1x_A": "i1x current1x current1xa",
    "sensitivity_1x": "s1x",
    "sensitivity": "ms maxs peaks",
    "complementary": "mt maxt peakt complementarysensitivity",
    "control_sensitivity": "ks maxks peakks",
    "delay_margin_s": "delay delaymargin",
    "disturbance.q_z": "q qz force forces unbalance imbalance",
    "disturbance.q_i": "qi",
    "sensor.runout": "runout",
    "actuator.u_max": "umax voltage vmax dclink",
    "clock.sample_period": "fs samplerate sampleperiod samplingrate rate period ts",
    "clock.duration": "duration",
    "processor.delay": "delay deadtime latency",
    "plant.m": "m mass weight rotormass",
    "plant.s_0": "s0 gap airgap nominalgap",
    "plant.i_0": "i0 bias biascurrent ibias",
    "plant.R": "resistance coilresistance",
    "plant.n": "turns windings",
    "plant.A": "polearea area",
    "plant.iron.saturation": "saturation bsat bs bmax saturationflux",
    "plant.iron.leakage": "leakage leakagefactor stray",
    "plant.iron.eddy": "eddy eddycurrents lamination",
    "run.clearance": "clearance",
    "run.seed": "seed",
}


# Quantities of a plant, and the numbers of the case file from which they follow.
DERIVED = {
    "ks": "mu_0, n, A, s_0 and i_0 (kappa i_0^2/s_0^3); 'ambjax check' prints it",
    "ki": "mu_0, n, A, s_0 and i_0 (kappa i_0/s_0^2); 'ambjax check' prints it",
    "l": "mu_0, n, A and s_0 (kappa/(2 s_0))",
    "inductance": "mu_0, n, A and s_0 (kappa/(2 s_0))",
    "kappa": "mu_0, n and A (mu_0 n^2 A)",
}


def meant(word: str, allowed: Iterable[str], elsewhere: Iterable[str] = ()) -> str | None:
    """Return the name that `word` probably means: one of `allowed`, or a name of another table; None if unknown."""
    names, plain = list(allowed), _plain(word)
    for name in names:
        if _plain(name) == plain or plain in other_words(name):
            return name
    lasts = {path: path.rpartition(".")[2] for path in elsewhere}
    paths = [path for path, last in lasts.items() if plain in (_plain(last), *other_words(last))]
    paths += [name for name, words in OTHER_WORDS.items() if "." in name and plain in words.split()]
    path = next(iter(paths or difflib.get_close_matches(word, names, n=1)), None)
    last = path.rpartition(".")[2] if path else ""
    return last if last in names else path


def other_words(name: str) -> list[str]:
    """Return the other words for a name; none if the table has no row for it."""
    return OTHER_WORDS.get(name, "").split()


def hint(word: str, allowed: Iterable[str], elsewhere: Iterable[str] = ()) -> str:
    """Return " Did you mean 'name'?" for the name that `word` probably means (`meant`); "" if unknown."""
    allowed = list(allowed)
    if _plain(word) in DERIVED and "mu_0" in allowed:
        return f" It follows from {DERIVED[_plain(word)]}."
    name = meant(word, allowed, elsewhere)
    return f" Did you mean '{name}'?" if name else ""


def hint_of_path(path: str, known: Iterable[str]) -> str:
    """Return the hint for a path: a name of its table for which its last name is another word, or a similar path."""
    known = list(known)
    table, _, name = path.rpartition(".")
    inside = [one.rpartition(".")[2] for one in known if one.rpartition(".")[0] == table]
    other = next((one for one in inside if _plain(name) in OTHER_WORDS.get(one, "").split()), None)
    if other:
        return f" Did you mean '{table}.{other}'?"
    close = difflib.get_close_matches(path, known, n=1)
    return f" Did you mean '{close[0]}'?" if close else ""


def _plain(word: str) -> str:
    return word.lower().replace("_", "").replace("-", "").replace(" ", "")
