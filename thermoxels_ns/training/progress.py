"""A line of progress now and then, the same on a terminal and in a file, in place of nerfstudio's table of timings."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from datetime import timedelta
from statistics import median

import tyro
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

_LINES = 20  # Lines of a training of usual length
_LONGEST_SILENCE_S = 60.0


@dataclass
class ProgressConfig(LocalWriterConfig):
    """Whether lines of progress are printed; nerfstudio's options about the form of its table have no use here."""

    _target: type = field(default_factory=lambda: ProgressLines)
    enable: bool = True
    """Print how many steps are done and how long the others will take."""
    stats_to_track: tyro.conf.Suppress[tuple[writer.EventName, ...]] = ()
    max_log_size: tyro.conf.Suppress[int] = 0


class ProgressLines(writer.LocalWriter):
    """Prints the steps done and the time that the others take at the present pace.

    A line comes at each twentieth of the steps, and after a minute without one.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None):
        super().__init__(config)
        for line in banner_messages or ():  # where the viewer is
            CONSOLE.print(line)
        self.said_s, self.said_part = time.monotonic(), -1

    def write_stats_log(self, step: int) -> None:
        """Print a line if one is due after step `step`, counted from 0."""
        steps, done = writer.GLOBAL_BUFFER["max_iter"], step + 1
        part, now = done * _LINES // steps, time.monotonic()
        if self.said_part < 0:  # the first step, of a resumed run too, says nothing about the pace
            self.said_s, self.said_part = now, part
        timings = writer.GLOBAL_BUFFER["events"].get(writer.EventName.ITER_TRAIN_TIME.value)
        if timings is None or done > steps or (part == self.said_part and now - self.said_s < _LONGEST_SILENCE_S):
            return
        self.said_s, self.said_part = now, part
        # The median: a step at which voxels are split takes seconds.
        left = timedelta(seconds=round((steps - done) * median(timings["buffer"])))
        more = f"; at this pace {left} more" if done < steps else ""
        CONSOLE.print(f"step {done:,} of {steps:,} ({100 * done / steps:.0f} %){more}", highlight=False)
