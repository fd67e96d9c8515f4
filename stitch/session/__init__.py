"""What was measured: session, robot, prepared scans, labelled points, what effects may know of the views."""
