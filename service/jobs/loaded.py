"""What jobs and plans need: importing this loads modules, and kernels of earlier processes."""

import open3d  # noqa: F401

from spheremark.pipelines import survey  # noqa: F401
from spheremark.pipelines.compilation import load_kernels
from spheremark.service.planning import plans, predictions  # noqa: F401
from spheremark.storage.catalogue import results  # noqa: F401
from spheremark.storage.clouds import stop  # noqa: F401

load_kernels()
