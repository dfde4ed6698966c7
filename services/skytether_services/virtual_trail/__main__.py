"""Process of the virtual trail: ``python -m skytether_services.virtual_trail``."""

from skytether.service import run
from skytether_services.virtual_trail.service import VirtualTrail

if __name__ == "__main__":
    run(VirtualTrail)
