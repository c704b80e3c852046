import json
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from spheremark.pipelines.errors import InputError, TruncatedRecordingError
from spheremark.storage import confined
from spheremark.storage.confined import (
    Limits,
    ReaderEndedError,
    UnreadableFileError,
    end_children,
    run_confined,
)

LIMITS = Limits(seconds=10.0, memory_bytes=256 << 20, result_bytes=1 << 20)
SHORT = Limits(seconds=1.0, memory_bytes=256 << 20, result_bytes=1 << 20)


READERS = "tests.storage.confined_readers"


@pytest.fixture(scope="module")
def forks():
    """A process that keeps the readers of these tests loaded."""
    made = confined._Forks(READERS, threading.BoundedSemaphore(2))
    yield made
    made.end()


@pytest.fixture(params=["started", "forked"])
def run(tmp_path, request, monkeypatch):
    """Run a reader in a process of its own, started anew or forked from one that is ready."""
    if request.param == "forked":
        forks = request.getfixturevalue("forks")
        monkeypatch.setitem(confined._FORKS, READERS, forks)
        forks.start()
    path = tmp_path / "file"
    path.write_bytes(b"12345")

    def read(reader, limits=LIMITS, **options):
        return run_confined(f"{READERS}:{reader}", path, limits, name="file.x", **options)

    return read


@pytest.fixture
def run_forked(run, request):
    """Run a reader that needs a process forked from one that is ready."""
    if "started" in request.node.name:
        pytest.skip("for forked readers")
    return run


def test_a_reader_gets_the_file_and_its_arrays_come_back(run):
    found = run("size_of")
    assert found["size"].tolist() == [5]
    assert found["nothing"].shape == (0, 3)


def test_a_reader_can_do_nothing_but_read_its_file(run, tmp_path, monkeypatch):
    monkeypatch.setenv("SPHEREMARK_TOKEN", "secret")
    (tmp_path / "secret").write_text("secret")
    monkeypatch.chdir(tmp_path)  # the path of a socket may have 107 characters
    listener = socket.socket(socket.AF_UNIX)
    listener.bind("socket")
    listener.listen()
    before = sorted(tmp_path.iterdir())
    with (
        socket.create_server(("127.0.0.1", 0)) as stream,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams,
    ):
        datagrams.bind(stream.getsockname())
        found = run("try_escapes", folder=str(tmp_path), port=stream.getsockname()[1])
        for one in (stream, datagrams):
            one.setblocking(False)
        with pytest.raises(BlockingIOError):
            stream.accept()
        with pytest.raises(BlockingIOError):
            datagrams.recv(1)
    listener.close()
    assert found["worked"].tolist() == []
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "secret").read_text() == "secret"


@pytest.mark.parametrize(
    ("reader", "limits", "reason"),
    [
        ("take_memory", LIMITS, "needs more than 256 MiB"),
        ("take_memory_in_c", LIMITS, "SIGABRT.*or needs more than 256 MiB"),
        ("take_time", SHORT, "took more than 1 s"),
        ("crash", LIMITS, "ended with SIGSEGV"),
        ("fail", LIMITS, r"file\.x cannot be read: about \[31m x{100}"),
        ("leave", LIMITS, "no sensible answer"),
        ("end_by_a_signal_without_a_name", LIMITS, "ended with 40"),
        ("give_much", LIMITS, "cannot be read"),
        ("give_objects", LIMITS, "no sensible answer"),
        ("refuse", LIMITS, r"file\.x is refused \.$"),
        ("nothing_of_this_name", LIMITS, "cannot be read"),
    ],
)
def test_a_reader_that_fails_is_an_error_with_its_reason(run, reader, limits, reason):
    with pytest.raises(InputError, match=reason) as found:
        run(reader, limits)
    assert len(str(found.value)) < 1000
    assert str(found.value).isprintable()


def begun():
    """Whether a reader of this process runs."""
    own = psutil.Process().children(recursive=True)
    return bool(confined._CHILDREN) or any(
        "--ready" in one.cmdline() and "--ready" in one.parent().cmdline() for one in own
    )


def test_the_end_of_the_service_ends_readers_and_none_that_is_ready(run, forks):
    ready = forks._process
    with ThreadPoolExecutor(1) as thread:
        future = thread.submit(run, "sleep")
        while not begun():
            assert not future.done()
        end_children()
        with pytest.raises(ReaderEndedError, match="it is read again"):  # no fault of the file
            future.result(timeout=60)
    assert not begun()
    assert forks._process is ready
    assert run("size_of")["size"].tolist() == [5]


def test_a_process_that_ends_takes_along_those_that_are_ready():
    program = (
        "from spheremark.storage import confined; confined.start_readers();"
        "print(confined._FORKS[confined.READY]._process.pid)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert not psutil.pid_exists(int(done.stdout))


def test_what_a_library_prints_is_no_part_of_the_answer(run):
    assert run("print_much")["x"].tolist() == [0.0]


def test_a_reader_that_ignores_its_timer_is_killed(run, monkeypatch):
    monkeypatch.setattr("spheremark.storage.confined._START_MAX", 1.0)
    begin = time.monotonic()
    with pytest.raises(UnreadableFileError, match="took more than 1 s"):
        run("sleep", SHORT)
    assert time.monotonic() - begin < 15
    assert not begun()


@pytest.mark.parametrize(
    "answer",
    [
        "", "{}", "[]", "3", '"refused"', "[" * 60_000, "x" * 100_000, '{"arrays": 3}',
        '{"arrays": [{"name": "x", "dtype": "|O", "shape": [1]}]}\n12345678',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": [1]}]}\n1234567',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": [-1]}]}\n12345678',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": [true]}]}\n12345678',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": [1e0]}]}\n12345678',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": 1}]}\n12345678',
        '{"arrays": [{"name": "x", "dtype": "<f8", "shape": [1, 1, 1, 1]}]}\n12345678',
        json.dumps({"arrays": [{"name": "x", "dtype": "<f8", "shape": [1 << 40]}]}) + "\n",
        json.dumps({"arrays": [{"name": "x", "dtype": "<f8", "shape": [1 << 62, 4]}]}) + "\n",
    ],
    ids=lambda text: text[:60],
)  # fmt: skip
def test_a_forged_answer_is_refused(run, answer):
    with pytest.raises(UnreadableFileError, match="no sensible answer"):
        run("forge", answer=answer)


def test_a_reader_that_unpacks_has_a_folder_of_its_own(run, tmp_path):
    assert run("use_own_folder", by_path=True) == {"text": "12345", "shown": "file"}
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_refusal_keeps_its_class(run):
    with pytest.raises(TruncatedRecordingError, match="it ends early"):
        run("refuse_by_class")


def test_an_answer_that_could_still_be_changed_is_none(run_forked):
    with pytest.raises(UnreadableFileError, match="no sensible answer"):
        run_forked("keep_the_answer_open")


def test_what_a_reader_leaves_behind_is_ended(run_forked, forks):
    run_forked("fork_on")
    server = psutil.Process(forks._process.pid)
    deadline = time.monotonic() + 60
    while server.children():
        assert time.monotonic() < deadline


def test_the_process_that_keeps_readers_loaded_is_started_anew(run_forked, forks):
    server = psutil.Process(forks._process.pid)
    server.kill()
    server.wait(60)
    assert run_forked("size_of")["size"].tolist() == [5]


def test_no_descriptor_stays_open(run):
    run("size_of")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for reader in ("size_of", "fail"):
        try:
            run(reader)
        except UnreadableFileError:
            assert reader == "fail"
    assert len(list(Path("/proc/self/fd").iterdir())) == before
