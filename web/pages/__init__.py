"""Pages: functions from values to HTML. Rows are mappings named as the database names them."""
