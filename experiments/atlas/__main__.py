from experiments.atlas.measure import main

if __name__ == "__main__":
    main()
