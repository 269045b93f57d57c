"""What many buildings take: stages of a batch that ran, drawn again and scheduled on machines of a given size.

    thermoxels batch LIST.csv --output-dir BATCH
    python tools/many_buildings.py BATCH --buildings 1000 --machines 10 --cores 16 --memory-gb 64

First a table of what each stage of the batch took. Then each of the buildings takes the seconds and the outcome of a
building of the batch that is drawn at random: one that failed fails at the same stage, and its later stages do not run.
Stages begin in the order of the list wherever the processors and the memory that `thermoxels batch` asks for are
free, as soon as those before them have ended. With `--ended-share` that share of the stages is ended halfway, as by a
machine that fails, and is run again from its beginning with twice the memory, as a batch does.
"""

import heapq
import json
import statistics
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from thermoxels_ns.commands.batch import AFTER, STAGES, plan_of, read_batch

FAILED = -1.0  # in place of the seconds of a stage that failed


def seconds_of(batch: Path) -> dict[str, dict[str, float]]:
    """Seconds of each stage of each building; print what they took."""
    found, peaks = dict[str, dict[str, float]](), dict[str, list[float]]()
    for name, building in read_batch(batch).items():
        for stage in plan_of(building, Path(name)):
            path = batch / name / f"{stage}.json"
            cost = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {"seconds": FAILED}
            if path.is_file() or (batch / name / "logs" / f"{stage}.failed.json").is_file():
                found.setdefault(name, {})[stage] = float(cost["seconds"])
            peaks.setdefault(stage, []).append(cost.get("peak_memory_gb") or 0.0)
    print("| stage | buildings | failed | seconds, median | most | memory, most |\n|---|---:|---:|---:|---:|---:|")
    for stage in STAGES:
        took = [one[stage] for one in found.values() if stage in one]
        done = [value for value in took if value != FAILED]
        if done:
            cells = f"{statistics.median(done):.0f}", f"{max(done):.0f}", f"{max(peaks[stage]):.1f} GB"
            print(f"| {stage} | {len(took)} | {len(took) - len(done)} | {' | '.join(cells)} |")
    for name in found:
        size = sum(file.stat().st_size for file in (batch / name).rglob("*") if file.is_file())
        print(f"{name}: {size / 1e6:.0f} MB on disk", flush=True)
    return found


@dataclass
class ManyBuildings:
    """Schedule many buildings, whose stages take what those of a batch took, on machines of a given size."""

    batch: tyro.conf.Positional[Path]
    """Folder of a batch that ran."""
    buildings: int = 1000
    machines: int = 10
    cores: int = 16
    """Processors of each machine."""
    memory_gb: float = 64.0
    """Memory of each machine, [1e9 bytes]."""
    ended_share: float = 0.01
    """Share of the stages that are ended from outside and run again."""
    seed: int = 0

    def main(self) -> None:
        """Print what the stages of the batch took, and what all buildings take together."""
        ran, rng = list(seconds_of(self.batch).values()), np.random.default_rng(self.seed)
        drawn = [ran[i] for i in rng.integers(len(ran), size=self.buildings)]
        free = [[self.cores, 1e3 * self.memory_gb] for _ in range(self.machines)]
        # What waits, the earliest building first: building, stage, attempt. What runs, by when it ends.
        waiting = [(i, stage, 1) for i, one in enumerate(drawn) for stage in one if AFTER.get(stage) not in one]
        running: list[tuple[float, int, str, int, int, bool]] = []
        now, busy, failed = 0.0, 0.0, Counter[str]()
        heapq.heapify(waiting)
        while waiting or running:
            later = []
            while waiting and max(cores for cores, _ in free) > 0:
                i, stage, attempt = heapq.heappop(waiting)
                cores, memory = STAGES[stage].threads, STAGES[stage].memory_mb * attempt
                at = next((m for m, (c, mb) in enumerate(free) if c >= cores and mb >= memory), None)
                if at is None:
                    later.append((i, stage, attempt))
                    if len(later) > self.cores:
                        break
                    continue
                free[at][0] -= cores
                free[at][1] -= memory
                ended = attempt == 1 and rng.random() < self.ended_share
                took = max(drawn[i][stage], 0.0) * (0.5 if ended else 1.0)
                busy += took * cores
                heapq.heappush(running, (now + took, i, stage, attempt, at, ended))
            for one in later:
                heapq.heappush(waiting, one)
            if not running:
                sys.exit(
                    f"A machine of {self.cores} processors and {self.memory_gb:g} GB is too small for {later[0][1]}."
                )
            now, i, stage, attempt, at, ended = heapq.heappop(running)
            free[at][0] += STAGES[stage].threads
            free[at][1] += STAGES[stage].memory_mb * attempt
            if ended:
                heapq.heappush(waiting, (i, stage, 2))
            elif drawn[i][stage] == FAILED:
                failed[stage] += 1
            else:
                for following in drawn[i]:
                    if AFTER.get(following) == stage:
                        heapq.heappush(waiting, (i, following, 1))
        share = busy / (now * self.machines * self.cores)
        print(f"{self.buildings} buildings on {self.machines} machines of {self.cores} processors: {now / 3600:.1f} h,")
        print(f"{busy / 3600:.0f} processor hours, processors busy {share:.0%}, failed: {dict(failed) or 'none'}")


if __name__ == "__main__":
    tyro.cli(ManyBuildings).main()
