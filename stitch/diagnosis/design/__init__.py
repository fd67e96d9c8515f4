"""What to measure next: candidate views and what they would tell apart."""
