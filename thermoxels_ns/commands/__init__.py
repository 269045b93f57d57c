"""The commands that users type; each command calls functions of several other packages."""
