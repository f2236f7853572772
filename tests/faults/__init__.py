"""Fault injection: `make fault-test` runs it in full (`python -m tests.faults`), `test_faults.py` a short form."""
