"""Names of tests and measurements as a person reads them, made of those that programs use. Pure functions."""

from __future__ import annotations

import re

GREEK = frozenset({"alpha", "delta", "omega", "phi", "psi", "tau", "theta"})
WORDS = {
    "backwards": "reverse", "emf": "EMF", "forwards": "forward", "hall": "Hall", "max": "maximum", "min": "minimum",
    "rms": "RMS", "rpm": "r/min", "std": "standard deviation", "thd": "THD",
}  # fmt: skip
SUBSCRIPT = 3  # letters at most: `u_dc` is a symbol, `d_ratio` is none


def in_words(name: str) -> str:
    """`error_std.fast` is "Error standard deviation, fast"; `i_q_light` is "i_q light"; `stop[2]` is "Stop, 2"."""
    name, bracket, case = name.partition("[")
    parts = [_words(part) for part in name.split(".")]
    text = ", ".join(parts) + (f", {case.removesuffix(']')}" if bracket else "")
    return text if "_" in text.split(" ")[0] else text[:1].upper() + text[1:]


def _words(part: str) -> str:
    """Of what stands between two dots: symbols stay together, underscores and abbreviations go."""
    tokens = part.split("_")
    found: list[str] = []
    while tokens:
        token = tokens.pop(0)
        if tokens and (len(token) == 1 or token in GREEK) and token.isalpha() and 0 < len(tokens[0]) <= SUBSCRIPT:
            token = f"{token}_{tokens.pop(0)}"
            if tokens[:1] == ["hat"]:
                token = f"{token}_{tokens.pop(0)}"
            found.append(token)
        else:
            found.append(re.sub(r"^([a-z]{3,})(\d+)$", r"\1 \2", WORDS.get(token, token)))
    return " ".join(found)
