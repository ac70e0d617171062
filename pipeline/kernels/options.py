"""How every loop is compiled."""

from typing import Any

OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"arcp", "nsz"}}
"""Arguments of numba's njit. Of fast math only what neither fuses nor reorders sums: what the compiler makes of that
freedom depends on what it compiles together, so a first run and a later one would differ (docs/decisions.md).
"""
