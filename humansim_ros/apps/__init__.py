"""Applications of the nodes, as commands of ``humansim`` run them."""
