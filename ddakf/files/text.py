"""Text of files that other programs wrote, in the encodings and with the line ends that they use."""

from __future__ import annotations

UTF8_MARK, UTF16_MARKS = b"\xef\xbb\xbf", (b"\xff\xfe", b"\xfe\xff")


def text_of(data: bytes) -> str:
    """The text of a file's bytes, whose lines end with a line feed.

    UTF-8, or UTF-16 with a byte-order mark; a mark is left out, and a byte that is no text becomes U+FFFD. Lines may end with
    CR, LF or both. No other byte ends one: ``str.splitlines`` would split letters of other encodings.
    """
    if data.startswith(UTF16_MARKS):
        text = data.decode("utf-16", "replace")
    else:
        text = data.removeprefix(UTF8_MARK).decode("utf-8", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def quoted(line: str, most: int = 60) -> str:
    """The beginning of a line for a message, without control characters."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in line.strip()[:most])
