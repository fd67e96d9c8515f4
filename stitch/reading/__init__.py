"""From the files of a session folder, a cloud, a table or a URDF to plain data; all refusals of bad input."""
