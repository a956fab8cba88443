from humansim_ros.people.humans.human import MAX_BONES as MAX_BONES
from humansim_ros.people.humans.human import Human as Human
from humansim_ros.people.humans.human import Skinning as Skinning
from humansim_ros.people.humans.human import joint_surfaces as joint_surfaces
from humansim_ros.people.humans.human import write_human as write_human
