"""Files are replaced whole: a death, a full disk or a link loses nothing, and no draft is left."""

from __future__ import annotations

import contextlib
import os
import signal
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from inner import Page, example_csv, write_page

import rcorefine as rco
from rcorefine.commands.example import example
from rcorefine.views.page import check_target
from rcorefine.writing import replacing

ROOT = Path(__file__).resolve().parent.parent
posix = pytest.mark.skipif(os.name == "nt", reason="modes, links and limits of POSIX")


def put(path, content=b"new"):
    with replacing(path) as stream:
        stream.write(content)


def names(folder):
    return sorted(item.name for item in folder.iterdir())


def page(text="text"):
    return Page("a page", "about", [text, "b.", "c."], True)


def refiner():
    chain = rco.mass_spring_damper([1.0, 2.0], [0.3, 0.2], [40.0, 30.0])
    one = rco.RCORefiner.paper(chain, dt=0.02, order=1, window=20)
    rng = np.random.default_rng(4)
    one.update(rng.standard_normal((1, 60)), rng.standard_normal((chain.linear.n_outputs, 60)))
    return one


def monitor():
    chain = rco.mass_spring_damper([1.0, 2.0], [0.3, 0.2], [40.0, 30.0])
    return rco.Monitor(chain, dt=0.02)


def page_writer():
    return lambda path: write_page(page(), path)


WRITERS = {"page": page_writer, "refiner": lambda: refiner().save, "monitor": lambda: monitor().save}


@posix
@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_keeps_what_was_there(writer, tmp_path):
    import resource

    path, write = tmp_path / "here.html", WRITERS[writer]()
    write_page(page("the old one"), path)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, hard))
    try:
        with pytest.raises(OSError, match=r"here\.html"):
            write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert names(tmp_path) == ["here.html"]


@posix
def test_a_full_disk_leaves_no_half_example(tmp_path):
    import resource

    example_csv("two_tanks")  # compiled before the disk is full
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))  # room for the model, not for the record
    try:
        with pytest.raises(OSError, match=r"two_tanks\.csv"):
            example("two_tanks", write=tmp_path / "new")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names(tmp_path / "new") == []


DIES = """
import os, signal, sys
from rcorefine.writing import replacing
with replacing(sys.argv[1]) as stream:
    stream.write(b"half")
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@posix
def test_a_killed_writer_loses_nothing_and_the_next_one_sweeps(tmp_path):
    path = tmp_path / "state of [today]*.npz"
    path.write_bytes(b"old")
    stranger = tmp_path / ".state of [today]*.npz.mine.tmp"
    stranger.write_bytes(b"not ours")
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(DIES), str(path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
        timeout=120,
    )
    assert done.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"old"
    assert len(names(tmp_path)) == 3  # what the dead one left
    put(path)
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == sorted([path.name, stranger.name])


def test_a_draft_in_the_works_is_not_swept(tmp_path):
    path = tmp_path / "state.npz"
    with replacing(path) as first:
        first.write(b"first")
        put(path, b"second")
        assert path.read_bytes() == b"second"
    assert path.read_bytes() == b"first"  # the last to finish
    assert names(tmp_path) == ["state.npz"]


def test_what_raises_leaves_the_old_one(tmp_path):
    path = tmp_path / "state.npz"
    path.write_bytes(b"old")
    with pytest.raises(TypeError), replacing(path) as stream:
        stream.writelines([b"half", "no bytes"])
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["state.npz"]


@posix
def test_mode_and_link_are_kept(tmp_path):
    path, link = tmp_path / "there" / "report.html", tmp_path / "link.html"
    path.parent.mkdir()
    path.write_text("")
    path.chmod(0o640)
    link.symlink_to("there/report.html")
    write_page(page(), link)
    assert link.is_symlink()
    assert "a page" in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert names(tmp_path) == ["link.html", "there"]
    dangling = tmp_path / "to come"
    dangling.symlink_to("there/later.npz")
    put(dangling)
    assert (tmp_path / "there" / "later.npz").read_bytes() == b"new"
    round_and_round = tmp_path / "loop"
    round_and_round.symlink_to("loop")
    with pytest.raises(OSError, match="loop"):
        put(round_and_round)


@posix
def test_a_new_file_has_the_mode_that_open_gives(tmp_path):
    put(tmp_path / "ours")
    (tmp_path / "theirs").write_bytes(b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "theirs").stat().st_mode


@posix
@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() != 0, reason="only root gives files away")
def test_owner_is_kept(tmp_path):
    path = tmp_path / "state.npz"
    path.write_bytes(b"old")
    os.chown(path, 1234, 4321)
    path.chmod(0o600)
    put(path)
    status = path.stat()
    assert (status.st_uid, status.st_gid, stat.S_IMODE(status.st_mode)) == (1234, 4321, 0o600)


@posix
def test_folders_are_written_through_to_the_disk(tmp_path, monkeypatch):
    """What a power cut must not undo: the file before it is renamed, the folder after."""
    order, one = [], refiner()
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(
        os, "fsync", lambda fd: (order.append("d" if stat.S_ISDIR(os.fstat(fd).st_mode) else "f"), fsync(fd))
    )
    monkeypatch.setattr(os, "replace", lambda *both: (order.append("r"), replace(*both)))
    one.save(tmp_path / "state.npz")
    assert order == ["f", "r", "d"]


@posix
def test_what_is_no_file_is_written_to(tmp_path):
    put(os.devnull)
    assert not Path(os.devnull).is_file()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with contextlib.closing(os.fdopen(reader, "rb")) as stream:
        assert check_target(pipe) == pipe
        put(pipe)
        assert stream.read() == b"new"
    assert names(tmp_path) == ["pipe"]


def test_errors_name_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        put(tmp_path / "no" / "state.npz")
    assert caught.value.filename == str(tmp_path / "no" / "state.npz")
    with pytest.raises(IsADirectoryError):
        put(tmp_path)
    put(tmp_path / ("ä" * 100))  # 200 bytes, as long as a name may be with a draft beside it


def test_an_empty_leftover_is_replaced_by_a_report(tmp_path):
    path = tmp_path / "report.html"
    path.touch()
    write_page(page(), path)
    assert "a page" in path.read_text()
