"""The page of an audit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import fields

from thermoxels_ns.audit.conditions import Survey, unknown_name
from thermoxels_ns.audit.draws import CONFIDENCE
from thermoxels_ns.audit.results import Audit
from thermoxels_ns.audit.run import F_RSI_M2K_W, MODERATE_SHARE, SEVERE_SHARE
from thermoxels_ns.reports.audit_pictures import MOST_DEFECTS, AuditPictures
from thermoxels_ns.reports.numbers import number_text, stated_text
from thermoxels_ns.reports.page import Picture, build_page


def audit_page(
    audit: Audit,
    pictures: AuditPictures | None,
    photographs: Mapping[int, tuple[Picture, ...]],
    mesh_name: str,
    command: str,
    files: Sequence[str],
) -> str:
    """Build the html text on an audit: the client's questions first, then elements and defects, method and limits last.

    `photographs` are those of defects, by their place.
    """
    numbered, asked = list(enumerate(audit.defects, start=1)), audit.conditions.calibrate
    counted = [(number, one) for number, one in numbered if not one.not_counted]
    loss, bound = abs(audit.whole.loss_w.value), audit.whole.loss_w.at_most or audit.whole.loss_w.unknown
    start = {} if asked is None else asked.stated()
    unknown = set() if asked is None else {unknown_name(one) for one in asked.unknown}
    return build_page(
        "audit.html.j2",
        audit=audit,
        counted=counted,
        doubted=[(number, one) for number, one in numbered if one.not_counted],
        worst=max(counted, key=lambda item: item[1].extra_w.value, default=None),
        worth_measuring=[name for name, width in audit.budget.items() if width > 0.2 * loss][:3],
        budget=[
            (name, number_text(width, width), "" if bound else f"{100.0 * width / (loss or 1.0):.0f} %")
            for name, width in audit.budget.items()
            if width > 5e-4 * (loss or 1.0)
        ],
        start=start,
        known={name: value for name, value in start.items() if name not in unknown},
        survey_rows=_survey(audit.conditions.survey),
        pictures=pictures,
        photographs=defaultdict(tuple, photographs),
        confidence=100.0 * CONFIDENCE,
        severe_share=SEVERE_SHARE,
        moderate_share=MODERATE_SHARE,
        f_rsi_m2k_w=F_RSI_M2K_W,
        most_defects=MOST_DEFECTS,
        mesh_name=mesh_name,
        command=command,
        files=files,
    )


def _survey(survey: Survey) -> list[tuple[str, str]]:
    """What a survey says of itself, by name."""
    units = {"pressure_difference": "Pa", "least_difference_24h": "K", "hours_since_sun": "h", "hours_dry": "h"}
    said = [(field.name, getattr(survey, field.name)) for field in fields(survey)]
    return [
        (name.replace("_", " "), stated_text(value, units.get(name, "")))
        for name, value in said
        if value not in (None, "")
    ]
