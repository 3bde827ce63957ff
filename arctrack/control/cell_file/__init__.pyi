from .choices import (
    BusChoice as BusChoice,
    CameraChoice as CameraChoice,
    CaptureChoice as CaptureChoice,
    CellFile as CellFile,
    CellJob as CellJob,
    MonitorChoice as MonitorChoice,
    ProcessChoice as ProcessChoice,
)
from .reader import is_cell_file as is_cell_file, read_cell_file as read_cell_file
