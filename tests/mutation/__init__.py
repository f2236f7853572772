"""Mutation testing: `python -m tests.mutation` changes one token at a time and sees whether a test fails.

Needs the extra `mutation`; CONTRIBUTING.md has the commands, docs/mutation.md the results. Not part of `make test`.
"""
