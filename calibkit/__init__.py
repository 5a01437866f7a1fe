"""calibkit finds the hidden unknowns of a multi-sensor rig and says how far each may be trusted."""

from calibkit.version import __version__

__all__ = ["__version__"]
