"""Two ends of a session over a made-up link in made-up time, for tests of what runs over a bridge."""

from skytether.emulator.link_model import LinkConditions
from skytether.emulator.lossy_link import LossyLink, Road

__all__ = ["LinkConditions", "LossyLink", "Road"]
