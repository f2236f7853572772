"""Tables and figures from result files of runs: `pages` makes a report, the other modules its parts."""
