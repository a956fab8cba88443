#!/bin/bash
# Run a command in the workspace of the image `jazzy`.
set -e
source /ws/install/setup.bash
exec "$@"
