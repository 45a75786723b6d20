"""Figures in words, the same on the terminal and in the report."""

from collections.abc import Iterable, Sequence

# line and paragraph separators, marks of direction, the byte order mark
_UNSEEN = {*range(0x200E, 0x2010), *range(0x2028, 0x202F), *range(0x2066, 0x206A), 0xFEFF, 0x061C}


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


def roughly(seconds: float) -> str:
    """A time that is only estimated, coarse: "some seconds", "about 40 s", "about 3 min"."""
    if seconds < 8:
        return "some seconds"
    if seconds < 55:
        return f"about {max(10, round(seconds / 10) * 10)} s"
    minutes = seconds / 60
    if minutes < 87.5:
        step = 1 if minutes < 19.5 else 5
        return f"about {max(1, round(minutes / step) * step)} min"
    hours = minutes / 60
    return f"about {hours:.1f} h" if hours < 9.95 else f"about {hours:.0f} h"


def about_room(count: int) -> str:
    """Bytes that are only roughly known: "about 190 MB", "about 2.3 GB"."""
    if count < 995_000_000:
        return f"about {round(count / 1e7) * 10} MB"
    return f"about {count / 1e9:.1f} GB"


def aligned(rows: Sequence[Sequence[str]], *, before: str = "", gap: str = "  ") -> list[str]:
    """Rows of words as lines whose columns line up; the last column is not padded."""
    columns = max((len(row) for row in rows), default=0)
    widths = [max(len(row[i]) for row in rows if len(row) > i) for i in range(columns)]
    lines = []
    for row in rows:
        padded = [f"{word:{width}}" for word, width in zip(row, widths, strict=False)]
        lines.append((before + gap.join(padded)).rstrip())
    return lines


def merged(texts: Iterable[str]) -> list[str]:
    """One sentence for texts that differ only in a leading "NAME: ": "a.jpg and 19 more: dark"."""
    groups: dict[tuple[bool, str], list[str]] = {}
    for text in texts:
        name, colon, rest = text.partition(": ")
        is_named = bool(colon) and " " not in name
        groups.setdefault((is_named, rest if is_named else text), []).append(name)
    said = []
    for (is_named, text), names in groups.items():
        more = len(names) - 1
        if is_named:
            said.append(f"{names[0]}{f' and {more} more' if more else ''}: {text}")
        else:
            said.append(f"{text} ({len(names)} times)" if more else text)
    return said


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
    r"""Text that any terminal, page, log and JSON takes, in one line.

    Bytes that are no UTF-8 become \xff, control characters and marks that turn the direction of
    text their codes: a file name can neither steer a terminal nor forge a line.
    """
    plain = str(text).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return plain if plain.isascii() and plain.isprintable() else "".join(map(_shown, plain))


def printable_lines(text: object) -> str:
    """`printable`, of text whose line ends and tabs are meant."""
    lines = str(text).split("\n")
    return "\n".join("\t".join(map(printable, line.split("\t"))) for line in lines)


def _shown(char: str) -> str:
    code = ord(char)
    is_control = code < 0x20 or 0x7F <= code < 0xA0 or code in _UNSEEN
    if not (is_control or 0xD800 <= code < 0xE000):
        return char
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
