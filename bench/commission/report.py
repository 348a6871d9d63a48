"""The report of a commissioning: one HTML file of one look. Nothing is fetched when it is read."""

from __future__ import annotations

from pathlib import Path

from bench.commission import words
from bench.commission.commissioned import Commissioned
from bench.commission.comparison import COLUMNS
from bench.commission.quantity import USUAL
from bench.param.differences import compare
from bench.report.html import embedded, page
from bench.report.words import NOT_STATED, date
from bench.signal.verdict import Verdict
from bench.signal.versions import PROGRAM

NEEDED, UNSURE = ("R_s", "L_d", "L_q", "L_d_half", "L_q_half", "t_dead", "psi_f", "J", "b", "tau_c"), 0.05
"""Quantities by which drives are set, and the share of one that its half width may be without being told."""
UNTOLD = {"u_dc_max": "the voltage that the drive bears", "i_cont": "the current that the winding bears for ever",
          "i2t_max": "the heat that it takes beyond that"}  # fmt: skip
"""Parameters that no measurement tells."""


def as_html(folder: Path, done: Commissioned) -> str:
    """The page; the steps' pictures are read from `folder`."""
    titles, rows = words.table(done.found.values(), done.converters)
    loadable, left = done.loadable()
    look = Verdict.PASS if not done.refused else Verdict.FAIL if not done.found else Verdict.INCOMPLETE
    return page(
        __package__ or "",
        "report.html.j2",
        (date,),
        name=done.drive.title,
        look=look,
        meaning=_meaning(done, len(rows)),
        about=_about(done),
        refused=list(done.refused.items()),
        by_hand=[*done.remarks, *left, *_by_hand(done)],
        titles=titles,
        rows=rows,
        comparison=done.comparison,
        columns=COLUMNS,
        steps=[
            (name, outcome.evidence.title, outcome.remarks, embedded(picture) if picture.is_file() else "",
             [(key, f"{value:.5g}") for key, value in outcome.evidence.figures.items()])
            for name, outcome in done.outcomes.items() for picture in [folder / f"{name}.png"]
        ],
        parameters=[
            (each.name, f"{each.a:.5g}", f"{each.b:.5g}", each.unit)
            for each in compare(done.drive, loadable).values
        ],
    )  # fmt: skip


def _meaning(done: Commissioned, shown: int) -> str:
    told = "1 quantity" if shown == 1 else f"{shown} quantities"
    if not done.refused:
        return f"All that was looked for was found: {told}."
    return f"Found: {told}. Refused: {', '.join(done.refused)}."


def _about(done: Commissioned) -> list[tuple[str, str]]:
    said, about = done.drive.identity, done.about
    rpm = about.get("rpm")
    return [
        ("Drive", str(said.get("name") or NOT_STATED)),
        ("Serial number", str(said.get("serial") or NOT_STATED)),
        ("Firmware", ", build ".join(str(said[key]) for key in ("firmware", "build") if said.get(key)) or NOT_STATED),
        *((key.capitalize(), str(about.get(key) or NOT_STATED)) for key in ("motor", "station", "operator")),
        ("Date and time", date(str(about.get("started", "")))),
        ("Link", str(about.get("target", ""))),
        ("Agreed to", f"{done.i_max:g} A" + (f", {rpm:.0f} r/min" if rpm else "")),
        ("Drive time", f"{done.seconds:.0f} s"),
        ("Instruments", "; ".join(about.get("instruments", ())) or "none: absolute values by the drive's converters"),
        ("Software", f"{PROGRAM} {about.get(PROGRAM, '')}"),
    ]


def _by_hand(done: Commissioned) -> list[str]:
    """What somebody should look at, a sentence each: what is not sure, or no measurement tells."""
    found, known, drive = done.found, done.converters, done.drive
    told = [f"{done.i_max:g} A is what was agreed to: compare it with the motor's plate, no measurement tells it"]
    if known.volts == USUAL.volts:
        told.append(
            f"the drive's volts are believed to {100.0 * known.volts:g} % (one standard deviation): compare u_dc with "
            "a voltmeter (--voltmeter), if absolute values matter"
        )
    if "n_p" not in done.settings and "R_s" in found:
        told.append("pole pairs were not found: count the magnets, or turn the shaft once by hand and count the steps")
    for name, quantity in found.items():
        share = quantity.half_width / abs(quantity.value) if quantity.value and name in NEEDED else 0.0
        if share > UNSURE:
            because = quantity.dominated_by
            told.append(f"{words.TITLES[name]} is known to {100.0 * share:.2g} % only, mostly because of: {because}")
    untold = [f"{name} ({drive[name]:g} {drive.entries[name].unit}, {meaning})"
              for name, meaning in UNTOLD.items() if name in drive]  # fmt: skip
    if untold:
        told.append(f"no measurement tells these limits, which stay as they are: {'; '.join(untold)}")
    return told
