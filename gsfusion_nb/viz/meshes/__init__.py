"""Meshes in a notebook: turned with the mouse, or as a picture.

pyvista draws the pictures, but not the widget: its interactive views need OpenGL, in the kernel or in the browser, and
a running kernel or a page of several megabytes. The widget here needs neither a graphics card nor a download.
"""
