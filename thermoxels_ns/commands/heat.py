"""The command ``thermoxels heat``: heat flow through an exported mesh in a scene."""

# Only light imports at the top, so that --help answers at once.

from __future__ import annotations

from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.heat_options import HeatOptions


@dataclass
class Heat(HeatOptions):
    """Let heat flow through an exported mesh: heat losses, U-values, cold spots, temperatures over time, a report.

    Writes report.html (open it first), answers.json, series.csv, temperatures for ParaView (heat.pvd through time,
    heat.vtu of a steady state) and pictures."""

    def main(self) -> None:
        """Run it; raises `ThermoxelsError` if the mesh, the scene or an option cannot be used, or the solver fails."""
        from rich.console import Console

        from thermoxels_ns.commands.heat_run import run_heat

        console = Console(highlight=False)
        # The last bits of a product of long vectors depend on how many threads BLAS has.
        with threadpool_limits(1, "blas"):
            run_heat(self, lambda line: console.print(line, markup=False, soft_wrap=True))
