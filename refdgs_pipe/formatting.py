"""Figures in words, the same on the terminal and in the report."""


def duration(seconds: float) -> str:
    """Seconds in words: 0.4 s, 12 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s" if whole % 60 else f"{whole // 60} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def size(count: int) -> str:
    """Bytes in words: 512 B, 3.2 MB."""
    if count < 1000:
        return f"{count} B"
    value, unit = count / 1000, "kB"
    for bigger in ("MB", "GB", "TB"):
        if value < 999.5:
            break
        value, unit = value / 1000, bigger
    return f"{value:.1f} {unit}"


def figure(value: float | int | str) -> str:
    """A measured value, with the digits that matter."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def counted(count: int, noun: str) -> str:
    """A number of things: no photos, 1 photo, 2 photos."""
    return f"{count or 'no'} {noun}{'' if count == 1 else 's'}"


def printable(text: object) -> str:
    r"""Text that any terminal, log and JSON takes: bytes that are no UTF-8 become \xff."""
    return str(text).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
