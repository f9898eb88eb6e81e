"""The paper's baseline map: averages on a grid."""
