"""Memory and disk that it takes to collect a dataset of Reacher and to train on it; Linux only.

    python benchmarks/memory.py [--steps 200000] [--workers 2] [--updates 300] [--folder FOLDER]

Runs ``examples/collect.py`` and ``examples/train_offline.py`` (size cpu, no evaluation, no videos) one after the other
and looks at all processes of each twice a second. RSS counts a page in every process that has it, PSS shares it among
them. Needs about 20 kB of disk per step for as long as it runs; a folder that is given is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
INTERVAL = 0.5
LOG_INTERVAL = 50
QUARTERS = (0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Sample:
    """What was seen at one moment: sums over the processes, bytes."""

    seconds: float
    steps: int
    processes: int
    rss: int
    pss: float
    largest: int
    disk: int


def process_tree(root: int) -> list[int]:
    """A process and all its descendants."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:  # it has ended meanwhile
                continue
            children.setdefault(parent, []).append(int(folder.name))
    tree = [root]
    for process in tree:
        tree += children.get(process, [])
    return tree


def memory(process: int) -> tuple[int, float]:
    """RSS and PSS of a process in bytes: 0 if it has ended, NaN for PSS if the system does not tell."""
    folder = Path(f"/proc/{process}")
    try:
        lines = (folder / "smaps_rollup").read_text().splitlines()[1:]
        sizes = {line.split(":")[0]: 1024 * int(line.split()[1]) for line in lines}
        return sizes["Rss"], sizes["Pss"]
    except ProcessLookupError:
        return 0, 0
    except OSError:
        pass
    try:
        return int((folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"), float("nan")
    except OSError:
        return 0, 0


def disk_size(folder: Path) -> int:
    """Bytes that the files of a folder take on the disk."""
    return sum(512 * file.stat().st_blocks for file in folder.rglob("*.memmap"))


def steps_in(dataset: Path) -> int:
    """Environment steps in a dataset; 0 if it is not there yet."""
    try:
        index = json.loads((dataset / "dataset.json").read_text())
    except FileNotFoundError:
        return 0
    return index["records"] - len(index["episode_lengths"])


def watch(script: str, dataset: Path, *overrides: str) -> list[Sample]:
    """Run one of the examples and look at its memory until it ends."""
    start, samples = time.perf_counter(), []
    process = subprocess.Popen([sys.executable, EXAMPLES / script, f"dataset={dataset}", *overrides], stdout=2)
    try:
        while process.poll() is None:
            sizes = [memory(one) for one in process_tree(process.pid)]
            rss, pss = zip(*sizes, strict=True)
            seconds, used = time.perf_counter() - start, sum(size > 0 for size in rss)
            samples.append(Sample(seconds, steps_in(dataset), used, sum(rss), sum(pss), max(rss), disk_size(dataset)))
            time.sleep(INTERVAL)
    finally:
        if process.poll() is None:
            for one in process_tree(process.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(one, signal.SIGKILL)
            process.wait()
    if process.returncode:
        sys.exit(f"{script} failed with exit code {process.returncode}")
    return samples


def at_quarters(samples: list[Sample], progress: list[float], name: str) -> list[float]:
    """Median of the ten samples up to each quarter of the way."""
    values = [getattr(sample, name) for sample in samples]
    ends = [next((i for i, done in enumerate(progress, 1) if done >= quarter), len(values)) for quarter in QUARTERS]
    return [statistics.median(values[max(0, end - 10) : end]) for end in ends]


def print_quarters(title: str, samples: list[Sample], progress: list[float]) -> None:
    print(f"\n{title:36}" + "".join(f"{quarter:12.0%}" for quarter in QUARTERS))
    for label, name in (("sum of RSS, MB", "rss"), ("sum of PSS, MB", "pss"), ("largest RSS, MB", "largest")):
        print(f"{label:36}" + "".join(f"{value / 1e6:12.0f}" for value in at_quarters(samples, progress, name)))


def report(dataset: Path, phases: dict[str, list[Sample]]) -> None:
    print(f"\n{'peak of':12}{'processes':>12}{'sum of RSS':>14}{'sum of PSS':>14}{'largest RSS':>14}{'seconds':>10}")
    for name, samples in phases.items():
        sums = [max(getattr(one, key) for one in samples) / 1e6 for key in ("rss", "pss", "largest")]
        print(f"{name:12}{max(one.processes for one in samples):12}", end="")
        print("".join(f"{size:11.0f} MB" for size in sums) + f"{samples[-1].seconds:10.0f}")

    collection, training = phases["collection"], phases["training"]
    steps = steps_in(dataset)
    print_quarters("at steps collected", collection, [one.steps / steps for one in collection])
    print_quarters("at time of training", training, [one.seconds / training[-1].seconds for one in training])

    size = disk_size(dataset)
    print(f"\ndisk: {size / 1e9:.2f} GB for {steps} steps, {size / steps:.0f} bytes per step", end="")
    print(f"; 1,000,000 steps: {size / steps / 1e3:.1f} GB")
    most = max(one.disk for one in collection)
    print(f"disk during collection, with room for more: at most {most / 1e9:.2f} GB, {most / size:.2f} of the result")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--updates", type=int, default=300, help=f"a multiple of {LOG_INTERVAL}")
    parser.add_argument("--folder", type=Path, help="where to put dataset and run; a temporary folder by default")
    arguments = parser.parse_args()
    if not sys.platform.startswith("linux"):
        sys.exit("benchmarks/memory.py reads /proc, which there is on Linux only")
    if arguments.updates % LOG_INTERVAL:
        parser.error(f"--updates must be a multiple of {LOG_INTERVAL}")
    if arguments.folder and any((arguments.folder / name).exists() for name in ("dataset", "run")):
        parser.error(f"{arguments.folder} holds a dataset or run already")

    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))  # do not leave gigabytes behind
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.folder or Path(temporary)).resolve()
        dataset = folder / "dataset"
        training = {"updates": arguments.updates, "log_interval": LOG_INTERVAL, "threads": 1}
        training |= {"eval_interval": 0, "video_interval": 0}
        overrides = [f"training.{key}={value}" for key, value in training.items()]
        print(f"Reacher, {arguments.steps} steps by {arguments.workers} workers; {arguments.updates} updates, size cpu")
        phases = {
            "collection": watch("collect.py", dataset, f"steps={arguments.steps}", f"workers={arguments.workers}"),
            "training": watch("train_offline.py", dataset, f"output={folder / 'run'}", "size=cpu", *overrides),
        }
        report(dataset, phases)


if __name__ == "__main__":
    main()
