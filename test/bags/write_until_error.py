"""Program: append frames to a bag until an error of the bag, and print it.

Arguments: folder, size of images in bytes, storage.
"""

import sys
from itertools import count
from pathlib import Path

from bag_support import TOPICS, append_frame

from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError


def main() -> None:
    try:
        with BagWriter(Path(sys.argv[1]), TOPICS, storage=sys.argv[3]) as writer:  # type: ignore[arg-type]
            for frame in count():
                append_frame(writer, frame, size=int(sys.argv[2]))
    except BagError as error:
        print(error)


if __name__ == "__main__":
    main()
