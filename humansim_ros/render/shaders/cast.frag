#version 330
// The still scene under the shadows of what moves, from two pictures of it: with the sun and without.
uniform sampler2D sunny;    // alpha: how much of the sun reaches it
uniform sampler2D sunless;
uniform sampler2D depths;   // metres, 0 where nothing is
uniform sampler2D rays;     // what pixels look along: x and y where z is 1, optical frame
uniform mat4 world;         // from the optical frame
uniform bool ground;        // whether the ground z = 0 takes shadows where nothing is
out vec4 rgb;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 lit = texelFetch(sunny, pixel, 0);
    float z = texelFetch(depths, pixel, 0).r;
    rgb = vec4(lit.rgb, 1.0);
    vec3 ray = mat3(world) * vec3(texelFetch(rays, pixel, 0).xy, 1.0);
    if (z == 0.0 && ground) z = max(-world[3].z / ray.z, 0.0);
    if (z == 0.0 || lit.a == 0.0) return;
    vec3 point = world[3].xyz + ray * z;
    float left = sunshine(moving_shadows, moving_depths, moving_map, point, vec3(0.0));
    if (left == 1.0) return;
    vec3 unlit = texelFetch(sunless, pixel, 0).rgb;
    rgb = vec4(sqrt(mix(unlit * unlit, lit.rgb * lit.rgb, left)), 1.0 - lit.a * (1.0 - left));
}
