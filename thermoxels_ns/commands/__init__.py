"""What users type: each command ties rooms together."""
