"""From scene folders to rays and temperatures."""
