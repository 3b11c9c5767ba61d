"""`ambjax reproduce`: the paper's scenarios, figures and claims."""

import argparse
import pathlib
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from tqdm import tqdm

from ambjax import paper
from ambjax.commands.outputs import directory, files, plain, say, table, write_json
from ambjax.ensemble.worker import processes
from ambjax.paper import ledger
from ambjax.paper.evidence import Evidence, gather
from ambjax.pictures import figures

Summary = dict[str, Any]


def _paper_figures(reading: str, evidence: Evidence, out: pathlib.Path) -> None:
    folder = out if reading == "repaired" else out / reading
    folder.mkdir(exist_ok=True)
    for number, (name, _) in figures.PAPER_FIGURES.items():
        title = f"Figure {number}: {name}, {reading} reading, {'under' if reading == 'tuned' else 'no'} noise"
        figures.paper_figure(number, getattr(evidence, name).trajectory, title, folder / f"figure_{number}.png")


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax reproduce."""

    out = directory(args.out, "reproduce")
    began = time.perf_counter()
    stages = 2 * 7 + 1
    with (
        files(out) as part,
        tqdm(
            total=stages, unit="stage", delay=2, leave=False, bar_format="{l_bar}{bar}| {n}/{total} [{elapsed}]"
        ) as bar,
    ):

        def stage(text: str) -> None:
            bar.set_description_str(f"{text:<34}")
            bar.update()

        # Tracing holds the interpreter, so the reading of another structure has one of its own; a thread draws.
        evidence, jobs = {}, []
        with ThreadPoolExecutor(1) as artist, processes(1) as other:
            tuned = other.submit(gather, "tuned")
            for reading in paper.READINGS:
                evidence[reading] = tuned.result() if reading == "tuned" else gather(reading, stage)
                jobs.append(artist.submit(_paper_figures, reading, evidence[reading], part))
            stage("figures and ledger")
            for job in jobs:
                job.result()
        std = paper.TABLE_2.noise_std
        words = f"Tracking under the paper's noise (std {std:.2g} m on z) and a {paper.SUPPLY:g} V supply"
        figures.readings(
            {name: one.noisy for name, one in evidence.items()}, words, paper.SETTLE, part / "readings.png"
        )
        claims, noise = ledger.judge(evidence), ledger.noise_table(evidence)
        (part / "ledger.md").write_text(ledger.markdown(claims, noise), encoding="utf-8")
        write_json(part / "ledger.json", {"claims": claims, "noise": noise})
    if not args.json:
        rows = [(c["says"], c["paper"], *(f["verdict"] for f in c["findings"].values())) for c in claims]
        print(table(("claim", "paper", *paper.READINGS), rows))
        print(f"written: {out}/figure_3.png to figure_6.png, the same under literal/ and tuned/,")
        print("         readings.png, ledger.md, ledger.json")
    say(f"done in {time.perf_counter() - began:.1f} s")
    return 0, {"claims": plain(claims), "noise": plain(noise), "out": str(out)}
