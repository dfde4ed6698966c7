"""Process of the recorder: ``python -m skytether_services.recorder``."""

from skytether.service import run
from skytether_services.recorder.service import Recorder

if __name__ == "__main__":
    run(Recorder)
