"""Results with self-contained HTML pages: of an evaluation, a control run and a log check."""
