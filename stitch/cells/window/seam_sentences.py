"""What a seam's stations say, in sentences: the same on the terminal, on the page and in the recording."""

from stitch.cells.window.seam import VERDICTS, Limits, Seam


def limits_text(limits: Limits) -> str:
    """What is allowed."""
    flush, gap = f"{limits.flush:g} ± {limits.flush_tolerance:g}", f"{limits.gap:g} ± {limits.gap_tolerance:g}"
    return f"flush {flush} mm, gap {gap} mm"


def stations_sentence(limits: Limits, seams: list[Seam]) -> str:
    """How many stations are good."""
    counts = {verdict: sum(s.verdict == verdict for s in seams) for verdict in VERDICTS}
    found = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"{len(seams)} stations: {found}. Allowed: {limits_text(limits)}."
