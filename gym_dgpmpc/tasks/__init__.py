"""Tasks: what an agent must know of its environment, found or given, and the vector that its model has to predict."""
