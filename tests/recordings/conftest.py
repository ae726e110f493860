"""The box room: exact depth in any layout."""

from box_room import box as box
