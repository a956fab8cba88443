"""Contact with the floor: standing feet, and the skin of somebody who lies or crawls."""
