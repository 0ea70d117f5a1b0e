"""What is matter: signed distances from splats, masks, depths or a mesh."""
