"""Meshes in a notebook: turned with the mouse, or as a picture.

pyvista draws the pictures. The widget is our own: pyvista's interactive views need OpenGL, in the kernel or in the
browser, and a running kernel or a page of several megabytes. This one needs neither a graphics card nor a download.
"""
