"""The foreign formats that can be converted, one file each (and what it needs)."""
