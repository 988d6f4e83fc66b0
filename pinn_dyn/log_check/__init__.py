"""Check of a log against mechanics: numbers, verdicts, figures and a page."""
