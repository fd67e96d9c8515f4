"""`stitch review RUN`: see where a run fails, add what is missing, watch the error fall; a local web application."""
