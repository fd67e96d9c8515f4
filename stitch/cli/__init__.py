"""The commands: parsing and printing only, every command is also a library function."""
