"""What views see in common: prepared scans, matches, sums over pairs, views freed by their overlaps."""
