"""Reports from saved results: signals, figures, pages, printable boards."""
