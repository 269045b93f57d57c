"""The dataparser of this package, which nerfstudio finds through an entry point."""

# This cannot be in `config.py`: nerfstudio discovers dataparsers while its own datamanagers are half imported.
from __future__ import annotations

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from thermoxels_ns.data.dataparser import ThermalDataParserConfig

thermal_data = DataParserSpecification(
    config=ThermalDataParserConfig(),
    description="Paired RGB and thermal photographs, or photographs alone (docs/data.md).",
)
