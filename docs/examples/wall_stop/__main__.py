"""Process of the example: ``python -m wall_stop``."""

from skytether.service import run
from wall_stop.service import WallStop

if __name__ == "__main__":
    run(WallStop)
