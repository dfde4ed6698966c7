"""Process of the example: ``python -m errand``."""

from errand.service import Errand
from skytether.service import run

if __name__ == "__main__":
    run(Errand)
