"""The multi-resolution hash grid."""
