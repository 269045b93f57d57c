"""Figures of thermal bridges and defects: extra heat flow, psi and chi, incidence and temperature factors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.audit.conditions import Conditions, Side
from thermoxels_ns.audit.defects import FoundDefect
from thermoxels_ns.audit.draws import Interval, interval_of
from thermoxels_ns.audit.exchange import PartTotals
from thermoxels_ns.audit.heat_flow import temperature_factor
from thermoxels_ns.audit.results import Defect, Severity
from thermoxels_ns.audit.surface import AuditedSurface
from thermoxels_ns.core.arrays import FloatArray

SEVERE_SHARE, MODERATE_SHARE = 0.05, 0.01
"""Shares of the observed heat loss from which on a defect is severe or moderate. They are ours, of no standard."""
F_RSI_M2K_W = (0.13, 0.25)
"""Resistances inside for which temperature factors are given, [m2 K / W]; the second is that for mould (ISO 13788)."""
_LEAST_FLOW_W_M2 = 1e-9


@dataclass(frozen=True)
class PartFigures:
    """Parts of the surface in every draw, and the error of one of them that the others do not share."""

    totals: PartTotals
    slope_w_k: FloatArray  # How the heat flow of each part changes with its readings, shape (parts,)
    off_k: FloatArray  # Draws of the error of the part's own readings, shape (k,), [K]

    def flow_w(self, part: int) -> FloatArray:
        """Heat flow of a part with that error, shape (k,)."""
        return self.totals.flow_w[part] + self.slope_w_k[part] * self.off_k

    def factors(self, part: int, side: Side) -> tuple[Interval, ...]:
        """Temperature factors of a part for `F_RSI_M2K_W`; none if seen from outside."""
        if side == "outside":
            return ()
        flow = np.maximum(self.flow_w(part) / max(self.totals.area_m2[part], 1e-12), _LEAST_FLOW_W_M2)
        above = self.totals.surface_c[part] + self.off_k - self.totals.outside_c
        return tuple(interval_of(np.asarray(temperature_factor(above / flow, one))) for one in F_RSI_M2K_W)

    def incidence(self, bridge: int, calm: int, side: Side) -> Interval | None:
        """I_tb = sum A_p (Ta - T_p) / (A (Ta - T_1D)), Ta the air on the side seen (Asdrubali and others).

        None where the undisturbed surface is not on the same side of the air in all draws.
        """
        air = self.totals.inside_c if side == "inside" else self.totals.outside_c
        undisturbed = self.totals.surface_c[calm] - air
        if undisturbed.min() <= 0.0 <= undisturbed.max():
            return None
        return interval_of((self.totals.surface_c[bridge] + self.off_k - air) / undisturbed)


def describe_defect(
    surface: AuditedSurface,
    conditions: Conditions,
    one: FoundDefect,
    figures: PartFigures,
    first_part: int,
    storey: str,
    whole_w: float,
) -> Defect:
    """Put figures to a defect: its zone is the part `first_part`, followed by its reference and its spot.

    Extra heat flow is that of the zone minus what the undisturbed surface near by would lose on the area that the zone
    stands on (psi = q_tb - q_uniform per metre, O'Grady and others 2017; areas are those of the outer surface).
    `whole_w` is the heat flow of all that was observed.
    """
    totals, side = figures.totals, conditions.side
    zone, reference, spot = first_part, first_part + 1, first_part + 2
    calm_w_m2 = totals.flow_w[reference] / max(totals.area_m2[reference], 1e-12)
    extra = figures.flow_w(zone) - calm_w_m2 * one.base_area_m2
    per_kelvin = extra / totals.difference_k / (one.length_m if one.kind == "line" else 1.0)
    extra_w, f_rsi = interval_of(extra), figures.factors(spot, side)
    around_c = float(totals.surface_c[reference, 0])
    area, spot_c = surface.area_m2[one.core], interval_of(totals.surface_c[spot] + figures.off_k)
    x, y, z = np.average(surface.centroid_m[one.core], axis=0, weights=area).tolist()
    return Defect(
        kind=one.kind,
        patch=surface.selection.patch_names[one.patch],
        storey=storey,
        centre_m=(x, y, z),
        height_m=float(np.average(surface.height_m[one.core], weights=area)),
        length_m=one.length_m,
        area_m2=float(area.sum()),
        departure_k=abs(spot_c.value - around_c),
        spot_c=spot_c,
        undisturbed_c=around_c,
        incidence=figures.incidence(zone, reference, side),
        extra_w=extra_w,
        coefficient=interval_of(per_kelvin),
        f_rsi=f_rsi,
        severity=_severity(conditions, extra_w, f_rsi, whole_w),
        not_counted=one.not_counted,
    )


def _severity(conditions: Conditions, extra: Interval, f_rsi: tuple[Interval, ...], whole_w: float) -> Severity:
    limit = conditions.limits.f_rsi
    if f_rsi and limit is not None and f_rsi[-1].high < limit.value:
        return "severe"
    if extra.low <= 0.0 or whole_w <= 0.0:
        return "uncertain"
    share = extra.value / whole_w
    return "severe" if share >= SEVERE_SHARE else "moderate" if share >= MODERATE_SHARE else "slight"
