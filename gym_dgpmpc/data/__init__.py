"""Transitions as they are stored, and what a dynamics model reads of them: encoding, standardisation, minibatches."""
