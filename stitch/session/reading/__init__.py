"""From the files of a session folder, a cloud, a table or a URDF to plain data; bad input is refused here."""
