from humansim_ros.data.datasets.data_set import DataSet as DataSet
