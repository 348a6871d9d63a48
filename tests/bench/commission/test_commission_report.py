"""The report of a commissioning as a reader has it: what was found and how sure, what was refused, what to check."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from test_commission_command import R, run_on
from test_comparison import a_file

from bench.commission.commissioned import Commissioned
from bench.commission.meters import Reading
from bench.commission.outcome import Evidence, Outcome
from bench.commission.quantity import Quantity
from bench.commission.report import as_html
from bench.errors import BenchError
from bench.param.table import ParameterEntry, Parameters
from tests.bench.accept.page import Page
from tests.bench.virtual_run import WatchedLink, simulated

EVIL = "<script>alert(1)</script>"


def reported(folder: Path, settings: dict[str, Any] | None = None, **options: Any) -> tuple[Page, Commissioned]:
    done = run_on(WatchedLink(simulated(**(settings or {}))), report=folder, **options)
    return Page(folder / "report.html"), done


@pytest.mark.long("a whole commissioning with its pictures")
def test_one_look_tells_all(tmp_path: Path) -> None:
    before = a_file({"J": 1.0}, drive={"serial": "SIM-0001"})
    page, done = reported(tmp_path, operator=EVIL, voltmeter=Reading(23.7, 1e-3), before=before)
    assert "script" not in page.tags
    assert page.subject["Operator"] == EVIL
    assert page.subject["Serial number"] == "SIM-0001"
    assert page.subject["Agreed to"] == "8 A, 3000 r/min"
    assert page.subject["Instruments"] == "a voltmeter that reads 23.7 V, to 0.1 %"
    assert re.match(r"20\d\d-\d\d-\d\d \d\d:\d\d:\d\d UTC", page.subject["Date and time"])
    quantity = done.found["R_s"]
    own, absolute = (100.0 * half / value for half, value in (
        (quantity.half_width, quantity.value),
        (quantity.absolute_half_width(done.converters), quantity.absolute_value(done.converters)),
    ))  # fmt: skip
    row = page.row("resistance of a phase", f"± {own:.2g} %", f"± {absolute:.2g} %")
    assert row.split()[4:6] == [f"{1e3 * quantity.value:.4g}", "mΩ"]
    assert f" {1e3 * R * 23.7 / 24:.3g}" in row  # absolute: the drive's volts are 24/23.7 of true ones
    assert "gain of the currents" in row
    headings = page.headings
    assert "What was refused" not in headings
    assert headings.index("To check by hand") < headings.index("What was found") < headings.index("How it was found")
    assert "the voltmeter reads 23.7 V, the drive 24 V, +1.3 %: more than is usual of a drive" in page.text
    assert "compare it with the motor's plate" in page.text
    assert "u_dc_max (32 V, the voltage that the drive bears)" in page.text
    assert "Since the commissioning of 2026-01-02" in page.text
    assert "something was attached then" in page.text
    assert "yes" in page.row("inertia of the shaft", "400 ukg m2")
    pictures = [source for source in page.sources if source.startswith("data:image/png;base64,")]
    assert len(pictures) == len(page.sources) == 7
    for source, step in zip(pictures, done.outcomes, strict=True):
        data = base64.b64decode(source.partition(",")[2])
        assert data == (tmp_path / f"{step}.png").read_bytes()
        assert Image.open(io.BytesIO(data)).size[0] > 500
    assert not page.links  # nothing is fetched


def test_what_was_refused_stands_before_what_was_found(tmp_path: Path) -> None:
    page, done = reported(tmp_path, {"faults__motor__open": 2}, current_a=8.0)
    assert "phase b carries no current: its wire, its winding or its half bridge is open" in page.text
    assert "Found: 2 quantities. Refused: first-current." in page.text
    assert page.headings[0] == "What was refused"
    assert "IN PART" in page.text
    assert set(done.outcomes) == {"offsets"}
    assert "resistance of a phase" not in page.text


@pytest.mark.long("a commissioning up to the resistance, with pictures")
def test_what_was_not_found_is_to_be_checked_by_hand(tmp_path: Path) -> None:
    page, _ = reported(tmp_path, steps=("r",))
    assert "count the magnets" in page.text
    assert "the drive's volts are believed to 0.5 % (one standard deviation)" in page.text
    assert page.subject["Instruments"].startswith("none")
    assert page.subject["Agreed to"] == "8 A"


def test_the_report_of_another_program_is_not_overwritten_unasked(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("of an acceptance")
    link = WatchedLink(simulated())
    with pytest.raises(BenchError, match=r"report\.html exists"):
        run_on(link, steps=("offsets",), report=tmp_path)
    assert not link.calls
    run_on(link, steps=("offsets",), report=tmp_path, overwrite=True)
    assert "Commissioning of" in (tmp_path / "report.html").read_text()


def test_a_report_without_its_pictures_is_one(tmp_path: Path) -> None:
    """Whoever has moved them away, or has none."""
    done = run_on(WatchedLink(simulated()), steps=("offsets",))
    (tmp_path / "x.html").write_text(as_html(tmp_path, done))
    assert Page(tmp_path / "x.html").sources == []


def test_what_the_drive_does_not_take_is_told_and_not_offered(tmp_path: Path) -> None:
    entries = (ParameterEntry("R_s_hat", 0.1, "Ω", lo=0.0, hi=1.0), ParameterEntry("J_hat", 1e-4, "kg m2"))
    found = Outcome((Quantity("R_s", "Ω", 2.0), Quantity("J", "kg m2", 2e-4)), Evidence("Both"))
    done = Commissioned(Parameters("a drive", {each.name: each for each in entries}), 5.0, {"spin": found})
    (tmp_path / "x.html").write_text(as_html(tmp_path, done))
    page = Page(tmp_path / "x.html")
    assert "R_s_hat = 2 Ω is beyond the drive's range, 0 to 1" in page.text
    assert page.text.count("R_s_hat") == 1
    assert "1 parameter would change" in page.text
    assert page.row("J_hat", "0.0001", "0.0002")
