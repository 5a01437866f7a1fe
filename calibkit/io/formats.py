"""The tables of foreign formats: a new one is a file beside this and a line in each table."""

from calibkit.io import kalibr, kalibr_export, opencv_yaml, openvins, ros_camera_info, vins
from calibkit.io.foreign import Exporter, Importer

IMPORTERS: dict[str, Importer] = {entry.name: entry for entry in (kalibr.IMPORTER, ros_camera_info.IMPORTER, opencv_yaml.IMPORTER)}
EXPORTERS: dict[str, Exporter] = {
    entry.name: entry
    for entry in (kalibr_export.EXPORTER, ros_camera_info.EXPORTER, opencv_yaml.EXPORTER, openvins.EXPORTER, vins.EXPORTER)
}
