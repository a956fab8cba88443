#version 330
// How much of the sun the still scene leaves to the ground z = 0, which is not drawn.
uniform sampler2D rays;  // what pixels look along: x and y where z is 1, optical frame
uniform mat4 world;      // from the optical frame
out float left;
void main() {
    vec3 ray = mat3(world) * vec3(texelFetch(rays, ivec2(gl_FragCoord.xy), 0).xy, 1.0);
    float z = -world[3].z / ray.z;
    left = z > 0.0 ? sunshine(still_shadows, still_depths, still_map, world[3].xyz + ray * z, vec3(0.0, 0.0, 1.0)) : 1.0;
}
