"""How reports say plain data: dates, keys, values. Pure functions; nothing here knows HTML."""

from __future__ import annotations

import math
from datetime import datetime

from protocol.text import told

WORDS = {"crc": "CRC", "id": "ID", "pwm": "PWM", "serial": "serial number", "started": "date and time"}
NOT_STATED = "not stated"
"""Of what nobody has said."""


def date(started: str) -> str:
    """Date, time and time zone, of ISO 8601; anything else as it is."""
    try:
        moment = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = moment.strftime("%z")
    return f"{moment:%Y-%m-%d %H:%M:%S}" + (f" UTC{zone[:3]}:{zone[3:5]}" if zone else "")


def labelled(key: str, value: object) -> tuple[str, str]:
    """A key of plain data and its value, as words: `pwm_hz` and 16000 are PWM and 16000 Hz."""
    text = plain(value)
    if key.endswith("_hz") and text.isdecimal():
        key = key.removesuffix("_hz")
        text = f"{text} Hz" if int(text) < 1e6 else f"{int(text) / 1e6:.9g} MHz"
    return " ".join(WORDS.get(word, word) for word in key.split("_")), text


def number(value: float | None, form: str, unknown: str = "–") -> str:
    """A number in this form, such as .2f; `unknown` for None and NaN."""
    return unknown if value is None or math.isnan(value) else f"{value:{form}}"


def plain(value: object) -> str:
    """A value of plain data, for people."""
    if not isinstance(value, float):
        return told(value)
    return ("−" if value < 0 else "") + f"{abs(value):g}"
