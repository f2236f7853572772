"""Models that learn an environment's transitions, each with the draws that plans are made through."""
