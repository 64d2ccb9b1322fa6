/*
   $about
*/
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

typedef $real ${name}_real;

$bits

typedef struct {
    $inputs
} ${name}_measured;

typedef struct {
    $outputs
} ${name}_setpoints;

/* Settings may be changed after init; the rest is the block's memory and its room to work in. */
typedef struct {
    $settings
    $memory
    struct {
        char unused;
        $arrays
    } work;
} $name;

/* Default settings, and reset. */
void ${name}_init($name *block);
/* Forget everything but the settings: the next automatic sample is a takeover. */
void ${name}_reset($name *block);
/* One call; it takes as many samples as control intervals have passed since the last one, up to $samples. */
void ${name}_step($name *block, const ${name}_measured *measured, ${name}_setpoints *setpoints);

#ifdef __cplusplus
}
#endif

#endif /* ${NAME}_H */
