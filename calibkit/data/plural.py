"""Numbers with their nouns, for what people read."""


def counted(n: int, one: str, many: str = "") -> str:
    """Return how many there are, in the words for one or for many: "1 view", "2 views"."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def plain(value: float, digits: int = 2) -> str:
    """Return a number to some digits without an exponent: "210", "0.04"."""
    rounded = f"{value:.{digits}g}"
    return f"{float(rounded):.0f}" if "e+" in rounded else rounded
