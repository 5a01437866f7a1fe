"""Camera models, one file a model, one table from name to model."""

from calibkit.models.cameras.base import CameraModel, Projection
from calibkit.models.cameras.kannala_brandt import KannalaBrandt
from calibkit.models.cameras.pinhole import Pinhole
from calibkit.models.cameras.pinhole_radtan import PinholeRadtan

_MODELS: tuple[CameraModel, ...] = (
    Pinhole(),
    PinholeRadtan("pinhole-radtan", 4),
    PinholeRadtan("pinhole-radtan5", 5),
    PinholeRadtan("pinhole-radtan8", 8),
    KannalaBrandt(),
)
CAMERAS: dict[str, CameraModel] = {model.name: model for model in _MODELS}
ALIASES = {"kb4": "pinhole-equi"}  # other names that people know a model by

__all__ = ["ALIASES", "CAMERAS", "CameraModel", "Projection"]
