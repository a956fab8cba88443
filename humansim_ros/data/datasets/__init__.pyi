from humansim_ros.data.datasets.data_set import DataSet as DataSet
from humansim_ros.data.datasets.data_set import write_data_set as write_data_set
