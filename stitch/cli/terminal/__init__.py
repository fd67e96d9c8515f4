"""What people see while a command works and when it ends: progress, tables, sentences."""
