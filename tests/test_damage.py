"""Damaged files: each kind of damage is found, the lost results are recomputed, and intact files are kept."""

import pathlib
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax.ensemble.store import Store
from ambjax.host import sealed
from ambjax.host.sealed import seal, unseal, write_whole
from tuning.solve.checkpoint import CheckpointFile, SearchState, remove_all
from tuning.solve.descent import begin

FACTS = {"seed": 3, "plant.m": "0.588"}
MEMBERS, CHUNK = 50, 20


def truncated(share):
    def damage(path):
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return damage


def flipped(share):
    """Change one byte within the data of an entry, at this share of the entries."""

    def damage(path):
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
        entry = entries[int(share * (len(entries) - 1))]
        content = bytearray(path.read_bytes())
        content[entry.header_offset + 30 + len(entry.filename) + entry.file_size - 1] ^= 0x10
        path.write_bytes(content)

    return damage


def rewritten(change, again=False):
    """Rewrite the file with changed arrays and facts, as another program would; with `again`, with a valid seal."""

    def damage(path):
        arrays, facts = unseal(path)
        with np.load(path) as kept:
            mark = kept["seal"]
        change(arrays, facts)
        if again:
            seal(path, arrays, facts)
        else:
            np.savez(path, **arrays, seal=mark)

    return damage


def first(arrays):
    """The name of an array that has rows."""
    return next(name for name, array in arrays.items() if array.ndim and name != "index")


def drop(arrays, facts):
    del arrays[first(arrays)]


def changed(change):
    """Return a function that replaces an array which has rows by the result of `change`."""

    def damage(arrays, facts):
        arrays[first(arrays)] = change(arrays[first(arrays)])

    return damage


shorten, alter = changed(lambda array: array[:-1]), changed(lambda array: array + 1e-9)
CHANGES = {
    "column missing": drop,
    "short array": shorten,
    "other dtype": changed(lambda array: array.astype(np.float32)),
    "column more": lambda arrays, _: arrays.update(more=np.zeros(len(arrays[first(arrays)]))),
}
# Whatever may happen to any sealed file: found though nothing is known of what it should hold.
DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("not an archive\n"),
    **{f"cut at {share:g}": truncated(share) for share in (0.01, 0.3, 0.7, 0.99)},
    **{f"flipped at {share:g}": flipped(share) for share in (0.0, 0.5, 1.0)},
    **{kind: rewritten(change) for kind, change in CHANGES.items()},
    "number changed": rewritten(alter),
    "no seal": lambda path: np.savez(path, a=np.zeros(3)),
}


def test_writing_is_all_or_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a"
    write_whole(path, lambda file: file.write(b"old"))

    def full(file):
        file.write(b"ne")
        raise OSError(28, "No space left on device")

    with pytest.raises(ValueError, match=r"a: cannot be written \(No space left on device\)"):
        write_whole(path, full)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


# --- the chunks of a study ---


def rows(start, stop):
    index = np.arange(start, stop)
    return {"index": index, "lost_at": np.where(index % 7, np.inf, 0.1), "lost": index % 7 == 0, "x": np.sin(index)}


def store_in(out, resume=True, chunk=CHUNK):
    store = Store(out, FACTS, MEMBERS, chunk)
    store.check(4, resume)
    store.begin()
    return store


def compute(store):
    """Compute all missing chunks, as a run does. Return the spans and the remarks."""
    missing, remarks = store.survey()
    for span in missing:
        store.put(span, rows(*span))
    return missing, remarks


@pytest.fixture
def whole(tmp_path):
    """Return members.npz of an undisturbed run."""
    store = store_in(tmp_path / "whole", resume=False)
    assert compute(store) == ([(0, 20), (20, 40), (40, 50)], [])
    return store.finish().read_bytes()


@pytest.fixture
def begun(tmp_path):
    """A study whose chunks are all computed, but not yet put together."""
    store = store_in(tmp_path / "out", resume=False)
    compute(store)
    return tmp_path / "out"


def chunk_file(out, number):
    return sorted((out / "chunks").glob("*.npz"))[number]


def renumbered(arrays, facts):
    arrays["index"] = arrays["index"] + 1


CHUNK_DAMAGE = DAMAGE | {
    **{f"sealed: {kind}": rewritten(change, again=True) for kind, change in CHANGES.items()},
    "rows of another chunk": lambda path: path.write_bytes(chunk_file(path.parent.parent, 0).read_bytes()),
    "other members": rewritten(renumbered, again=True),
    "another study's": rewritten(lambda _, facts: facts.update(study=sealed.checksum_of({})), again=True),
    "no facts": rewritten(lambda _, facts: facts.clear(), again=True),
}


@pytest.mark.parametrize("kind", CHUNK_DAMAGE)
def test_a_chunk_that_is_damaged_or_of_another_study_is_computed_again(kind, begun, whole):
    path = chunk_file(begun, 1)
    CHUNK_DAMAGE[kind](path)
    store = store_in(begun)
    missing, (remark,) = compute(store)
    assert missing == [store.spans()[1]]
    assert store.finish().read_bytes() == whole
    assert not store.chunks.exists()
    assert str(path) in remark
    assert "are computed again" in remark
    assert "\n" not in remark


def test_chunks_are_kept_until_members_npz_is_verified(begun, whole, monkeypatch):
    """The disk returns other data than were written."""
    spoil = [truncated(0.5), flipped(0.7), rewritten_plainly(drop), rewritten_plainly(shorten)]
    spoil += [rewritten_plainly(renumbered), rewritten_plainly(alter)]
    for damage in spoil:
        store = store_in(begun)

        def lying(path, write, damage=damage):
            write_whole(path, write)
            if path.name == "members.npz":
                damage(path)

        with monkeypatch.context() as disk:
            disk.setattr("ambjax.ensemble.store.write_whole", lying)
            with pytest.raises(ValueError, match=r"members.npz: the chunks could not be merged .* They are kept"):
                store.finish()
        assert len(list(store.chunks.glob("*.npz"))) == 3
        assert not store_in(begun).finished()
    store = store_in(begun)
    assert compute(store) == ([], [])
    assert store.finish().read_bytes() == whole
    assert not store.chunks.exists()


def rewritten_plainly(change):
    def damage(path):
        with np.load(path) as kept:
            arrays = {name: kept[name] for name in kept.files}
        change(arrays, {})
        np.savez(path, **arrays)

    return damage


def test_a_chunk_damaged_before_the_end_is_reported_and_no_result_is_written(begun):
    store = store_in(begun)
    compute(store)
    truncated(0.5)(chunk_file(begun, 1))
    with pytest.raises(ValueError, match="They are kept: repeat the command with --resume"):
        store.finish()
    assert not store.path.exists()
    assert len(list(begun.rglob("*.part"))) == 0


@pytest.mark.parametrize("kind", ["gone", *(k for k in DAMAGE if k != "column missing")])
def test_a_finished_study_whose_file_was_damaged_is_computed_again(kind, begun, whole):
    store_in(begun).finish()
    path = begun / "members.npz"
    if kind == "gone":
        path.unlink()
    elif kind in (*CHANGES, "number changed"):
        rewritten_plainly(CHANGES.get(kind, alter))(path)
    else:
        DAMAGE[kind](path)
    store = store_in(begun)
    assert not store.finished()
    missing, (remark,) = compute(store)
    assert missing == store.spans()
    assert remark.startswith(f"{path}: ")
    assert store.finish().read_bytes() == whole
    assert store_in(begun).finished()


@pytest.mark.parametrize("kind", ["empty", "text", "cut at 0.3", "cut at 0.99", "a byte", "a chunk"])
def test_a_damaged_manifest_is_refused_by_name(kind, begun):
    path = begun / "study.json"
    if kind == "a byte":
        path.write_text(path.read_text().replace('"seed": 3', '"seed": 2'))
    elif kind == "a chunk":
        path.write_text(path.read_text().replace('"chunk": 20', '"chunk": 10'))
    else:
        DAMAGE[kind](path)
    with pytest.raises(ValueError, match=r"study.json: cannot be read \(.*\)") as raised:
        store_in(begun)
    assert "\n" not in str(raised.value)
    assert len(list((begun / "chunks").glob("*.npz"))) == 3


def test_the_chunk_size_of_the_directory_is_the_default(begun, whole):
    store = store_in(begun, chunk=None)
    assert store.chunk == CHUNK
    assert compute(store) == ([], [])
    assert store.finish().read_bytes() == whole
    with pytest.raises(ValueError, match="another study: chunk is 20 in the file and 10 in this run"):
        store_in(begun, chunk=10)


def test_a_study_that_ended_before_its_first_chunk_is_resumed(tmp_path, whole):
    """Its folder is marked, and records no chunk size. Any chunk size is accepted, and then recorded."""
    for chunk in (None, CHUNK):
        out = tmp_path / str(chunk)
        store_in(out, resume=False, chunk=None)
        store = store_in(out, chunk=chunk)
        assert (store.chunk, store.count()) == (chunk or 0, 0)
        store.cut(CHUNK)
        assert store_in(out, chunk=None).chunk == CHUNK
        compute(store)
        assert store.finish().read_bytes() == whole


# --- the checkpoints of a search ---

SEARCH_FACTS = {"case": {"plant": {"m": 0.5}}, "tune": {"members": 4}}
STARTS, GAINS, ITERATIONS = 3, 4, 2


def search_of(starts=STARTS, gains=GAINS):
    row = {"value": (), "x": (gains,), "gains": (gains,), "lost": (), "members": ()}
    row |= {"terms": (6,), "quantities": (1,), "rollouts": ()}
    dice = np.random.default_rng(1)
    past = {name: [dice.random(shape) for _ in range(ITERATIONS)] for name, shape in row.items()}
    x = jnp.asarray(dice.random((starts, gains)))
    return SearchState(begin(x), past, seconds=2.5, converged=True)


@pytest.fixture
def checkpoint(tmp_path):
    checkpoint_file = CheckpointFile(tmp_path / "checkpoints" / "round-2.npz", SEARCH_FACTS, 2, print)
    checkpoint_file.save(search_of())
    return checkpoint_file


def test_a_loaded_checkpoint_equals_the_saved_search(checkpoint):
    before, after = search_of(), checkpoint.load()
    for a, b in zip(jax.tree.leaves(before.starts), jax.tree.leaves(after.starts), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    assert (after.iteration, after.earlier) == (ITERATIONS, 2.5)
    assert after.ended
    assert after.converged
    assert before.history.keys() == after.history.keys()
    assert all(np.array_equal(before.history[name], after.history[name]) for name in before.history)


CHECKPOINT_DAMAGE = DAMAGE | {
    "no state": rewritten(lambda arrays, _: arrays.pop("start_best"), again=True),
    "no seconds": rewritten(lambda _, facts: facts.pop("seconds"), again=True),
    "no facts": rewritten(lambda _, facts: facts.clear(), again=True),
}


@pytest.mark.parametrize("kind", CHECKPOINT_DAMAGE)
def test_a_search_with_a_damaged_checkpoint_starts_again_with_one_line(kind, checkpoint, capsys):
    CHECKPOINT_DAMAGE[kind](checkpoint.path)
    assert checkpoint.load() is None
    said = capsys.readouterr().out
    assert said.startswith(f"{checkpoint.path}: ")
    assert said.endswith("; search 2 begins again\n")
    assert said.count("\n") == 1
    checkpoint.save(search_of())
    assert checkpoint.load() is not None


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (SEARCH_FACTS | {"case": {"plant": {"m": 0.6}}}, "case.plant.m is 0.5 in the file and 0.6 in this run"),
        (SEARCH_FACTS | {"version": "0"}, "in the file and 0 in this run"),
        (SEARCH_FACTS | {"jax": "0"}, "in the file and 0 in this run"),
        (SEARCH_FACTS | {"precision": "float32"}, "precision is float64 in the file and float32 in this run"),
    ],
)
def test_a_checkpoint_of_another_search_is_refused_with_the_difference(other, words, checkpoint):
    with pytest.raises(ValueError, match=r"round-2.npz belongs to another search") as raised:
        CheckpointFile(checkpoint.path, other, 2).load()
    assert words in str(raised.value)
    assert checkpoint.path.exists()


def test_only_old_checkpoints_are_removed(checkpoint, tmp_path):
    others, folder = ["round-10", "round-2b.npz", "round-my-net.npz", "history.npz"], checkpoint.path.parent
    for name in others:
        (folder / name).touch()
    (folder / "round-7.npz").mkdir()
    assert remove_all(tmp_path) == 1
    assert sorted(p.name for p in folder.iterdir()) == sorted([*others, "round-7.npz"])
    assert remove_all(pathlib.Path(tmp_path, "nowhere")) == 0
