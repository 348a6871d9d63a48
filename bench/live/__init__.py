"""`bench live`: stream a drive, watch or spin it, sum the run up."""
