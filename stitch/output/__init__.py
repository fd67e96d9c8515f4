"""What is written and what reads it: result, run folder, page data, comparison."""
