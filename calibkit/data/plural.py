"""Numbers with their nouns, for what people read."""


def counted(n: int, one: str, many: str = "") -> str:
    """Return how many there are, in the words for one or for many: "1 view", "2 views"."""
    return f"{n} {one if n == 1 else many or one + 's'}"
