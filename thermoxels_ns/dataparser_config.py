"""The dataparser of this package, which nerfstudio finds through an entry point."""

# This cannot be in `config.py`: nerfstudio discovers dataparsers while its own datamanagers are half imported.
from __future__ import annotations

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from thermoxels_ns.core import quiet_warnings
from thermoxels_ns.data.dataparser import ThermalDataParserConfig

quiet_warnings.silence()  # the first of our modules that an ``ns-*`` command imports, before nerfstudio's models
thermal_data = DataParserSpecification(
    config=ThermalDataParserConfig(),
    description="Paired RGB and thermal photographs, or photographs alone (docs/data.md).",
)
