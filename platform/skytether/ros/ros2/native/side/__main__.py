"""Started by its path, because ROS 2's Python does not have our packages: ``python3 .../side/__main__.py SOCKET``."""

from __future__ import annotations

import importlib.util
import sys
from functools import partial
from pathlib import Path

_NAME = "skytether_ros2_side"


def _main() -> int:
    folder = Path(__file__).resolve().parent
    sys.path = [entry for entry in sys.path if Path(entry or ".").resolve() != folder]  # its names are common ones
    found = importlib.util.spec_from_file_location(
        _NAME, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if found is None or found.loader is None:
        raise ImportError(f"{folder} is no package")
    sys.modules[_NAME] = package = importlib.util.module_from_spec(found)
    found.loader.exec_module(package)
    real_time = importlib.import_module(f"{_NAME}.real_time")
    before = real_time.leave()
    program = importlib.import_module(f"{_NAME}.program")
    return int(program.main(sys.argv[1:], partial(real_time.resume, before)))


if __name__ == "__main__":
    sys.exit(_main())
