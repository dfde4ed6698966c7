"""Process of the recorder: ``python -m skytether_services.recorder``."""

import sys

from skytether.service import run

try:
    from skytether_services.recorder.service import Recorder
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] != "mcap":
        raise
    sys.exit("error: the recorder needs the library mcap; install it with: pip install 'skytether[recorder]'")

if __name__ == "__main__":
    run(Recorder)
