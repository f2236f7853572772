"""The contact study of the paper's supplement: how well models predict a cart that hits the end of its rail.

`study` runs it on the `data` of one case; `scores` says how good the predictions are, `result_files` keeps them, and
`report` with its `figures` makes a page of them. docs/contact_study.md explains the study.
"""
