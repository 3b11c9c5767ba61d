"""Ctrl-C gives one line and exit code 130 in every command; it is deferred where a step must be completed."""

import subprocess
import sys

import pytest

HEAD = """
import os, signal, sys, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from ambjax.host.interrupts import deferred, exit_on_interrupt, raise_if_interrupted, reporting, uninterrupted

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)

def ever():
    time.sleep(60)
    sys.exit("nothing happened")
"""
# What runs when it comes, what the line says.
CASES = {
    "asleep": ("with exit_on_interrupt('p'):\n interrupt()\n ever()", "p: interrupted.\n"),
    "where exceptions are lost": (
        "class Lost:\n def __del__(self):\n  interrupt()\n  ever()\nwith exit_on_interrupt('p'):\n Lost()\n ever()",
        "p: interrupted.\n",
    ),
    "where everything is caught": (
        "with exit_on_interrupt('p'):\n while True:\n  try:\n   interrupt()\n   ever()\n  except BaseException: pass",
        "p: interrupted.\n",
    ),
    "while it is being kept": (
        "n = [0]\nwith exit_on_interrupt('p'), reporting(lambda: f'{n[0]} are kept'):\n with uninterrupted():\n"
        "  interrupt()\n  time.sleep(0.2)\n  n[0] = 1\n ever()",
        "p: interrupted: 1 are kept.\n",
    ),
    "again": (
        "with exit_on_interrupt('p'), deferred('It ends.'):\n interrupt()\n time.sleep(0.2)\n interrupt()\n ever()",
        "p: It ends. Ctrl-C again ends it at once.\np: interrupted.\n",
    ),
    "before its files are complete": (
        "import pathlib\nfrom ambjax.results.outputs import files\nos.mkdir('out')\n"
        "with exit_on_interrupt('p'), files(pathlib.Path('out')) as part:\n"
        " (part / 'a').write_text('')\n interrupt()\n ever()",
        "p: interrupted.\n",
    ),
    "stderr is full": (
        "w = os.pipe()[1]\nos.set_blocking(w, False)\ntry:\n while True: os.write(w, bytes(65536))\n"
        "except BlockingIOError: os.set_blocking(w, True)\nos.dup2(w, 2)\nwith exit_on_interrupt('p'):\n"
        " interrupt()\n ever()",
        "",
    ),
    "below a bar": (
        "from tqdm import tqdm\nwith exit_on_interrupt('p'), tqdm(total=9, mininterval=0) as bar:\n bar.update(3)\n"
        " interrupt()\n ever()",
        "\np: interrupted.\n",
    ),
}


def run(code, folder=None):
    return subprocess.run([sys.executable, "-c", HEAD + code], capture_output=True, text=True, timeout=50, cwd=folder)


@pytest.mark.parametrize("case", CASES)
def test_ctrl_c_ends_the_program_at_once_with_one_line(case, tmp_path):
    code, said = CASES[case]
    done = run(code, tmp_path)
    assert not list(tmp_path.iterdir())
    assert done.returncode == 130, done.stderr
    assert done.stderr.endswith(said)
    assert case == "below a bar" or done.stderr == said


def test_a_deferred_interrupt_is_raised_when_polled():
    code = """
with exit_on_interrupt("p"):
    with deferred("It ends."):
        raise_if_interrupted()
        interrupt()
        time.sleep(0.2)
        try:
            raise_if_interrupted()
        except KeyboardInterrupt:
            print("raised")
with exit_on_interrupt("p"):
    raise_if_interrupted()
print("anew", signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["raised", "anew", "True"]


def test_an_ignored_sigint_stays_ignored():
    code = "signal.signal(signal.SIGINT, signal.SIG_IGN)\nwith exit_on_interrupt('p'):\n interrupt()\n print('on')"
    done = run(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "on\n", "")
