"""How progress is reported: a callback, and what it is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping

Info = Mapping[str, str | int | float]
"""What else there is to say, by name: ``accept``, ``rhat``, ``ess``, ``solves_per_s``; and of which ``group``."""

Report = Callable[[str, int, int, Info], None]
"""Called as ``report(phase, done, total, info)``: steps done of a phase, and a few numbers or words by name."""
