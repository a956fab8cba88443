"""Program: write frames into a bag until it is killed, and print a line for each frame in the file.

Arguments: folder, size of images in bytes, max_size of files, whether the bag is continued.
"""

import sys
from itertools import count

from bag_support import TOPICS, messages_of

from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError


def main() -> None:
    folder, size, max_size, resume = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "True"
    try:
        with BagWriter(folder, TOPICS, max_size=max_size, custom={"plan": "p"}, resume=resume) as writer:
            for frame in count(100 if resume else 0):
                writer.write(messages_of(frame, size))
                writer.flush()
                print(frame, flush=True)
    except BagError as error:
        print(error)


if __name__ == "__main__":
    main()
