"""Process of following in front: ``python -m skytether_services.follow_in_front``."""

from skytether.service import run
from skytether_services.follow_in_front.service import FollowInFront

if __name__ == "__main__":
    run(FollowInFront)
