"""Tables for pandas, which is loaded only when one is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


def data_frame(
    data: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    index: Any = None,
    name: str = "t",
    units: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Columns (n,) by name, or n rows, as a DataFrame. `index`: n values of its index `name`; None: 0 … n - 1.

    `units` of the columns become `attrs["units"]`. Raises ImportError where pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise ImportError("DataFrames need pandas: pip install 'hallbench[pandas]'") from None
    frame = pd.DataFrame(data, index=None if index is None else pd.Index(index, name=name))
    if units is not None:
        frame.attrs["units"] = dict(units)
    return frame
