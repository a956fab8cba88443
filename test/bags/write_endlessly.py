"""Program: append frames to a bag until it is killed.

Prints a line for each frame.
Arguments: folder, storage, size of images in bytes, max_size of files, whether direct writing is refused.
"""

import sys
from itertools import count

from bag_support import TOPICS, append_frame

from humansim_ros.data.bags.mcap_file import DirectFile
from humansim_ros.data.bags.metadata import Storage
from humansim_ros.data.bags.writer import BagWriter


def main() -> None:
    folder, size, max_size = sys.argv[1], int(sys.argv[3]), int(sys.argv[4])
    storage: Storage = "sqlite3" if sys.argv[2] == "sqlite3" else "mcap"
    if sys.argv[5] == "True":
        DirectFile.write = lambda *_: 0  # type: ignore[method-assign]
    with BagWriter(folder, TOPICS, storage=storage, max_size=max_size, custom={"plan": "p"}) as writer:
        for frame in count():
            append_frame(writer, frame, size=size)
            print(frame, flush=True)


if __name__ == "__main__":
    main()
