from humansim_ros.scene.checks.checks import check_scene as check_scene
