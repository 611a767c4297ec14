"""Sweeps that are killed, interrupted, run twice at once, or run out of disk, and taken up again.

Nothing enters; a group of verdicts leaves. Each sweep (`sweep_run`) is a process of its own. It is
right if, taken up again, it has the samples of one that nothing happened to, bit for bit.
"""

import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.reliability.verdict import Group, Verdict

ROOT = Path(__file__).parents[2]
PATIENCE = 300  # seconds


def begin(folder):
    """A sweep under way."""
    command = [sys.executable, "-m", "benchmarks.reliability.sweep_run", str(folder)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def finish(process):
    """(return code, hash or nothing, what it said) of one that comes to its end."""
    out, said = process.communicate(timeout=PATIENCE)
    lines = out.split()
    return process.returncode, lines[-1] if lines else "", said.strip()


def wait_for(folder, pattern, count, process):
    """Until the folder holds as many files of a name, or the process has ended."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and process.poll() is None:
        if len(list(Path(folder).glob(pattern))) >= count:
            return
        time.sleep(0.0005)


def kill_after(folder, *files):
    """Killed as soon as there are so many files of each name, one name after the other."""
    process = begin(folder)
    for pattern, count in files:
        wait_for(folder, pattern, count, process)
    process.send_signal(signal.SIGKILL)
    code, *_ = finish(process)
    return "" if code == -signal.SIGKILL else f"ended with {code} before it was killed"


def killed(folder):
    """Killed while the third piece is written."""
    return kill_after(folder, ("lanes-*", 2), (".*-lanes-*", 1))


def killed_at_once(folder):
    """Killed while the record of the sweep is written."""
    return kill_after(folder, (".*-sweep*", 1))


def full_disk(folder):
    """No file may grow any more once two pieces are there."""
    process = begin(folder)
    wait_for(folder, "lanes-*", 2, process)
    if process.poll() is None:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (16, 16))
    code, _, said = finish(process)
    last = said.split("\n")[-1]
    told = code == 1 and last.startswith("OSError: ") and "what was finished before is kept" in last
    return "" if told else f"ended with {code}: {last}"


def interrupted(folder):
    """Ctrl-C once two pieces are there: what is finished comes back, with a warning."""
    process = begin(folder)
    wait_for(folder, "lanes-*", 2, process)
    process.send_signal(signal.SIGINT)
    code, _, said = finish(process)
    told = "lanes are finished" in said
    return "" if told else f"ended with {code}: {said[-200:]}"


def two_at_once(folder):
    """Two processes at one checkpoint: both end, with the same samples."""
    both = [finish(process) for process in [begin(folder), begin(folder)]]
    codes, hashes = {code for code, *_ in both}, {found for _, found, _ in both}
    return "" if codes == {0} and len(hashes) == 1 else f"ended with {codes}, samples {hashes}"


FAULTS: tuple[Callable, ...] = (killed, killed_at_once, full_disk, interrupted, two_at_once)


def judge(fault, whole):
    """The verdict on one fault: what it must tell, and what the sweep is when taken up again."""
    with tempfile.TemporaryDirectory() as folder:
        complaint = fault(Path(folder) / "sweep")
        code, found, said = finish(begin(Path(folder) / "sweep"))
    name = fault.__name__.replace("_", " ")
    if code:
        return Verdict(name, "refused", f"not taken up again: {said[-200:]}")
    if complaint or found != whole:
        return Verdict(name, "wrong", complaint or "other samples when taken up again")
    return Verdict(name, "right")


def uninterrupted():
    """The hash of a sweep that nothing happens to."""
    with tempfile.TemporaryDirectory() as folder:
        return finish(begin(Path(folder) / "sweep"))[1]


def groups(systems, seed):
    """All faults."""
    whole = uninterrupted()
    yield Group("faults", "a sweep with a checkpoint", [judge(fault, whole) for fault in FAULTS])
