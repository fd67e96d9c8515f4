"""What is missing without a name: which kinds of errors repeat, which joint errs and where in its range."""
