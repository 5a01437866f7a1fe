"""Numbers with their nouns, for what people read."""


def counted(number: int, noun: str) -> str:
    """Return "1 view", "2 views"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
