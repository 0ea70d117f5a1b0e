"""A volume from slices that a 2-D model has inpainted."""
