"""Readers of scene folders, which turn photographs and poses into rays and temperatures."""
