import os

import pytest

os.environ.setdefault("JAX_ENABLE_X64", "1")


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder of the test's own, with the compilation cache beside it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))
