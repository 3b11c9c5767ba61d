"""`ambjax reproduce`: simulate the paper's scenarios, draw its figures and judge its claims."""

import argparse
import pathlib
import time
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor

from tqdm import tqdm

from ambjax import paper
from ambjax.ensemble.worker import processes
from ambjax.host.heartbeat import say
from ambjax.paper import ledger
from ambjax.paper.evidence import Evidence, gather
from ambjax.pictures import figures
from ambjax.pictures.scales import save
from ambjax.results.outputs import described, directory, drawn, files, plain, table, write_json, written

# Labels of the tuned readings in readings.png.
SHOWN_AS: dict[str, str] = {"tuned": "tuned in continuous time", "sampled": "tuned for the processor"}


def _paper_figures(reading: str, evidence: Evidence, out: pathlib.Path) -> None:
    folder = out if reading == "repaired" else out / reading
    folder.mkdir(exist_ok=True)
    for number, (name, _) in figures.PAPER_FIGURES.items():
        title = f"Figure {number}: {name}, {reading} reading, {'under' if reading in paper.NOISY else 'no'} noise"
        figure = figures.paper_figure(number, getattr(evidence, name).trajectory, title)
        save(figure, folder / f"figure_{number}.png", 150)


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Reproduce the paper and write its figures and the ledger of claims."""
    try:
        return _reproduced(args)
    except BrokenExecutor:
        why = "a worker process died, perhaps because memory ran out. Nothing is kept: start again."
        raise ValueError(why) from None


def _reproduced(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    folders = ["" if reading == "repaired" else f"{reading}/" for reading in paper.READINGS]
    drawings = [f"{folder}figure_{number}.png" for folder in folders for number in figures.PAPER_FIGURES]
    names = ["readings.png", "ledger.md", "ledger.json", *drawings]
    out = directory(args.out, "reproduce", names, args.force)
    began = time.perf_counter()
    stages = 2 * 8 + 2
    with (
        files(out) as part,
        tqdm(
            total=stages, unit="stage", delay=2, leave=False, bar_format="{l_bar}{bar}| {n}/{total} [{elapsed}]"
        ) as bar,
    ):

        def stage(text: str) -> None:
            bar.set_description_str(f"{text:<34}")
            bar.update()

        # JAX holds the GIL while it traces. The readings that need other programs therefore run in a second process.
        # The figures are drawn in a thread.
        evidence, jobs = {}, []
        with ThreadPoolExecutor(1) as artist, processes(1) as other:
            theirs = {reading: other.submit(gather, reading) for reading in paper.NOISY}
            for reading in (reading for reading in paper.READINGS if reading not in theirs):
                evidence[reading] = gather(reading, stage)
                jobs.append(artist.submit(_paper_figures, reading, evidence[reading], part))
            stage("sensitivity")  # while the second process runs
            sensitivity = ledger.sensitivity_table(paper.READINGS)
            for reading, job in theirs.items():
                evidence[reading] = job.result()
                jobs.append(artist.submit(_paper_figures, reading, evidence[reading], part))
            stage("figures and ledger")
            for job in jobs:
                described("a figure", job.result)
        std = paper.TABLE_2.noise_std
        words = f"the paper's noise (std {std:.2g} m on z), {paper.SUPPLY:g} V"
        words = f"Tracking on a 10 kHz processor with a delay of one sample, under {words}"
        shown = {str(SHOWN_AS.get(name, name)): one.on_processor[True].trajectory for name, one in evidence.items()}
        drawn(part / "readings.png", lambda: figures.readings(shown, words, paper.SETTLE))
        claims, noise = ledger.judge_claims(evidence), ledger.noise_table(evidence)
        processor = ledger.processor_table(evidence)
        summary = {"claims": claims, "noise": noise, "processor": processor, "sensitivity": sensitivity}
        (part / "ledger.md").write_text(ledger.ledger_markdown(summary), encoding="utf-8")
        write_json(part / "ledger.json", plain(summary))
    if not args.json:
        rows = [(c["says"], c["paper"], *(f["verdict"] for f in c["findings"].values())) for c in claims]
        print(table(("claim", "paper", *paper.READINGS), rows))
        written(out, "figure_3.png to figure_6.png, the same under literal/, tuned/ and sampled/,")
        print("         readings.png, ledger.md, ledger.json")
    say(f"done in {time.perf_counter() - began:.1f} s")
    return 0, plain(summary | {"out": str(out)})
