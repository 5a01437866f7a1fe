"""Camera models, one file a model, one table from name to model."""

from calibkit.models.cameras.base import CameraModel, Projection
from calibkit.models.cameras.kannala_brandt import KannalaBrandt
from calibkit.models.cameras.pinhole_radtan import PinholeRadtan4, PinholeRadtan5, PinholeRadtan8

CAMERAS: dict[str, CameraModel] = {model.name: model for model in (PinholeRadtan4(), PinholeRadtan5(), PinholeRadtan8(), KannalaBrandt())}

__all__ = ["CAMERAS", "CameraModel", "Projection"]
