"""A Cortex-M4F under QEMU: compile programs with an exported controller and run them there.

`missing()` returns the names of the tools that are not installed. Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi
qemu-system-arm.
"""

import pathlib
import shutil
import subprocess

GCC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
TARGET = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]
FLAGS = ["-std=gnu99", "-O2", "-Wall", "-Wextra", "-ffp-contract=off", *TARGET]
# The vectors are at 0. The reset handler enables the floating-point unit and calls newlib's start code.
START = """#include <stdint.h>
extern void _start(void);
void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm volatile("dsb\\n isb");
    _start();
}
static void stuck(void)
{
    __asm volatile("bkpt");
}
__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    (void *)0x00380000, (void *)reset, (void *)stuck, (void *)stuck, (void *)stuck, (void *)stuck, (void *)stuck};
"""


def missing() -> str:
    """Return the reason why no program can run on a Cortex-M4F; empty if one can."""
    absent = [tool for tool in (GCC, QEMU) if shutil.which(tool) is None]
    return f"{' and '.join(absent)} not found" if absent else ""


def size(source: pathlib.Path) -> tuple[int, int]:
    """Return the bytes of code and constants of a source, and the deepest stack frame of its functions."""
    target = source.with_suffix(".arm.o")
    subprocess.run([GCC, *FLAGS, "-fstack-usage", "-c", source, "-o", target], check=True)
    listed = subprocess.run(["arm-none-eabi-size", target], check=True, capture_output=True, text=True).stdout
    frames = target.with_suffix(".su").read_text().splitlines()
    return int(listed.splitlines()[1].split()[0]), max(int(line.split("\t")[1]) for line in frames)


def run(sources: list[pathlib.Path], folder: pathlib.Path, *more: str) -> tuple[int, str]:
    """Return the exit code and the output of a program of these sources. `more`: options of QEMU."""
    (folder / "start.c").write_text(START)
    program = folder / "program.elf"
    linked = ["--specs=rdimon.specs", "-Wl,--section-start=.vectors=0x0", "-lm"]
    subprocess.run([GCC, *FLAGS, f"-I{folder}", folder / "start.c", *sources, "-o", program, *linked], check=True)
    machine = ["-M", "mps2-an386", "-cpu", "cortex-m4", "-display", "none", "-monitor", "none", "-serial", "none"]
    machine += ["-semihosting-config", "enable=on,target=native", *more, "-kernel", str(program)]
    done = subprocess.run([QEMU, *machine], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout + done.stderr
