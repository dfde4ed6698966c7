"""Process of the example: ``python -m patrol``."""

from patrol.service import Patrol
from skytether.service import run

if __name__ == "__main__":
    run(Patrol)
