"""Process of navigation: ``python -m skytether_services.navigation``."""

from skytether.service import run
from skytether_services.navigation.service import Navigation

if __name__ == "__main__":
    run(Navigation)
