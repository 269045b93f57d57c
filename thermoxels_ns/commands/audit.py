"""The command ``thermoxels audit``: heat loss, U-values and thermal bridges from measured temperatures."""

# Only light imports at the top, so that --help answers at once.

from __future__ import annotations

from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.audit_options import AuditOptions


@dataclass
class Audit(AuditOptions):
    """Say from the temperatures that thermal images measured: heat loss, U-values and thermal bridges, as intervals.

    Writes audit.html (open it first, or print it), answers.json, and surface.vtp for ParaView. What was known on site
    stands in a yaml file: ``thermoxels audit --write-conditions conditions.yaml`` writes one that explains itself."""

    def main(self) -> None:
        """Run it; raises `ThermoxelsError` if the mesh, the conditions or an option cannot be used."""
        from rich.console import Console

        from thermoxels_ns.commands.audit_run import run_audit

        console = Console(highlight=False)
        # The last bits of a product of long vectors depend on how many threads BLAS has.
        with threadpool_limits(1, "blas"):
            run_audit(self, lambda line: console.print(line, markup=False, soft_wrap=True))
