"""Write assets/humans/humans.json: the facts about the built-in humans that `humansim human list` prints.

python tools/assets/list_humans.py     # after a change of a built-in human
"""

import json
from pathlib import Path

from humansim_ros import load_human
from humansim_ros.cli.human import BUILT_IN_FACTS, built_in_humans, describe_human

ROOT = Path(__file__).resolve().parents[2]

if __name__ == "__main__":
    facts = [describe_human(load_human(name)) for name in built_in_humans()]
    (ROOT / BUILT_IN_FACTS).write_text(json.dumps(facts, indent=1) + "\n")
